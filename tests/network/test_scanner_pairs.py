"""Networks whose clocks differ, and whose scanners are mounted upside-down."""

from collections.abc import Mapping

import numpy as np
import pytest

from calgraph.config import Lidar2dSpec, People, Rig
from calgraph.config.settings import TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.network import scanner_pairs
from calgraph.network.options import NetworkEstimator, NetworkOptions
from calgraph.network.pairs.clock_mounting_search import ClockMountingHypothesis
from calgraph.network.pipeline import calibrate_tracks
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.result import Calibration
from calgraph.simulation import (
    GroundTruth,
    NetworkScenario,
    SimulatedNetwork,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)

pytestmark = pytest.mark.slow

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
INVERTED, LATE = "scanner_3", "scanner_2"
Network = tuple[Rig, dict[str, ScannerTracks], GroundTruth]


@pytest.fixture(scope="module")
def lab() -> Network:
    """Four scanners that are upright, with equal clocks."""
    scenario = NetworkScenario(layout="lab", duration=20, scanner={"count": 4}, people={"count": 2})  # type: ignore[arg-type]
    return track(build_network(scenario, 0))


def track(network: SimulatedNetwork) -> Network:
    """The tracks of all scanners."""
    rig, tracked = network_rig(network), {}
    for scanner in network.scanners:
        spec = rig.sensors[scanner.name]
        assert isinstance(spec, Lidar2dSpec)
        assert isinstance(rig.target, People)
        found = track_scanner(
            simulate_scans(network, scanner), rig.target, spec.noise, settings=TrackingSettings()
        )
        assert isinstance(found, ScannerTracks)
        tracked[scanner.name] = found
    return rig, tracked, network_truth(network)


def calibrate(
    lab: Network,
    *,
    clocks: Mapping[str, float] | None = None,
    inverted: tuple[str, ...] = (),
    mountings: Mapping[str, str] | None = None,
    estimator: NetworkEstimator = "joint",
) -> Calibration:
    rig, tracked, _ = lab
    sensors = {
        name: spec.model_copy(update={"mounting": (mountings or {}).get(name)})
        for name, spec in rig.sensors.items()
    }
    tracked = {
        name: correct_tracks(one, clock_offset=-(clocks or {}).get(name, 0.0), inverted=name in inverted)
        for name, one in tracked.items()
    }
    options = NetworkOptions(estimator=estimator)
    return calibrate_tracks(rig.model_copy(update={"sensors": sensors}), tracked, options)


def largest_error(found: Calibration, truth: GroundTruth, inverted: tuple[str, ...] = ()) -> float:
    """Of all poses but the root's, m and rad."""
    flips = {name: FLIP if name in inverted else np.eye(4) for name in truth.T_root_sensor}
    errors: list[Array] = [
        se3.difference(s.T_root_sensor, flips[found.root] @ truth.T_root_sensor[s.name] @ flips[s.name])
        for s in found.sensors
    ]
    return float(np.abs(errors).max())


@pytest.mark.parametrize("mountings", [{}, {INVERTED: "inverted"}])
def test_an_inverted_scanner_has_a_roll_of_180_degrees(lab: Network, mountings: dict[str, str]) -> None:
    found = calibrate(lab, inverted=(INVERTED,), mountings=mountings)
    assert len(found.sensors) == 4
    assert largest_error(found, lab[2], (INVERTED,)) < 0.01
    assert found[INVERTED].T_root_sensor[2, 2] == pytest.approx(-1)
    assert found.planar
    recognised = [remark for remark in found.evidence.remarks if f"{INVERTED} is mounted upside-down" in remark]
    assert len(recognised) == (not mountings)


@pytest.mark.parametrize("mountings", [{}, {"scanner_1": "inverted"}])
def test_others_are_inverted_relative_to_an_inverted_root(lab: Network, mountings: dict[str, str]) -> None:
    found = calibrate(lab, inverted=("scanner_1",), mountings=mountings)
    assert largest_error(found, lab[2], ("scanner_1",)) < 0.01
    assert all(s.T_root_sensor[2, 2] == pytest.approx(-1) for s in found.sensors if s.name != found.root)


@pytest.mark.parametrize("estimator", ["joint", "averaging"])
def test_a_clock_that_differs_is_found_and_corrected(lab: Network, estimator: NetworkEstimator) -> None:
    found = calibrate(lab, clocks={LATE: 0.28, INVERTED: -0.9}, inverted=(INVERTED,), estimator=estimator)
    assert largest_error(found, lab[2], (INVERTED,)) < (0.01 if estimator == "joint" else 0.05)
    assert f"the clock of {LATE} differs from that of scanner_1 by +0.28 s" in "; ".join(found.evidence.remarks)
    if estimator == "joint":
        clock, stddev = found[LATE].clock_offset, found[LATE].clock_offset_stddev
        assert clock is not None
        assert stddev is not None
        assert abs(clock - 0.28) < 0.002
        assert stddev < 0.001


def test_a_clock_beyond_the_search_is_named(lab: Network) -> None:
    found = calibrate(lab, clocks={LATE: 3.0})
    remark = next(remark for remark in found.evidence.remarks if f"the clock of {LATE} may differ" in remark)
    assert "by +3.0 s, more than the 1 s that are corrected" in remark
    assert LATE in found.evidence.unconnected


def test_a_stated_mounting_that_tracks_contradict_is_named(lab: Network) -> None:
    found = calibrate(lab, inverted=(INVERTED,), mountings={INVERTED: "upright"})
    assert any(
        f"the tracks of {INVERTED} fit the other scanners as mirrored ones only" in remark
        for remark in found.evidence.remarks
    )
    assert INVERTED in found.evidence.unconnected or found[INVERTED].verdict.grade == "weak"


def test_equal_clocks_and_mountings_have_no_remark(lab: Network) -> None:
    found = calibrate(lab)
    assert largest_error(found, lab[2]) < 0.01
    assert found.evidence.remarks == ()


def test_a_cart_before_a_person_is_no_delay() -> None:
    """In a corridor one scanner detects the cart, and another one the person behind it: they fit with 0.4 s."""
    scenario = NetworkScenario(layout="halls", duration=60, people={"carts": 1})  # type: ignore[arg-type]
    rig, tracked, truth = track(build_network(scenario, 1))
    found = calibrate_tracks(rig, tracked, NetworkOptions())
    assert len(found.sensors) == 4
    assert largest_error(found, truth) < 0.03
    refused = "the tracks of scanner_3 and scanner_4 match best with a clock offset of +0.40 s"
    assert any(remark.startswith(refused) for remark in found.evidence.remarks)
    assert not any("found from the tracks, and corrected" in remark for remark in found.evidence.remarks)
    assert found["scanner_4"].verdict.grade == "weak"


@pytest.mark.parametrize(("offset", "named"), [(3.0, True), (-3.0, True), (0.9, False)])
def test_only_clocks_beyond_the_search_are_named_as_distant(
    lab: Network, monkeypatch: pytest.MonkeyPatch, offset: float, named: bool
) -> None:
    """A scanner without a pair may match others within the search, too: its clock was not confirmed."""
    rig, tracked, _ = lab
    found = ClockMountingHypothesis("scanner_1", LATE, False, offset, 0.001, 200.0, 0.0, 1.0)
    monkeypatch.setattr(scanner_pairs, "search_clocks_and_mountings", lambda *_args, **_options: [found])
    tracked = {name: tracked[name] for name in ("scanner_1", LATE)}
    pairs = {("scanner_1", LATE): Rejected("too little time")}
    findings = scanner_pairs._find_distant_clocks(rig, tracked, pairs, {}, NetworkOptions())
    assert any(f"the clock of {LATE} may differ from that of scanner_1" in one.text for one in findings) == named


@pytest.mark.parametrize(("rate", "inverted"), [(1.0, frozenset()), (4e-4, frozenset({LATE}))])
def test_mirrored_tracks_that_match_by_chance_invert_no_scanner(
    lab: Network, monkeypatch: pytest.MonkeyPatch, rate: float, inverted: frozenset[str]
) -> None:
    """Two scanners have the least evidence, unless a match by chance is expected of every pair."""
    rig, tracked, _ = lab
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence._RATE", rate)
    mirrored = ClockMountingHypothesis("scanner_1", LATE, True, 0.0, 0.05, 80.0, 0.0, 1.0)
    monkeypatch.setattr(scanner_pairs, "search_clocks_and_mountings", lambda *_args, **_options: [mirrored])
    tracked = {name: tracked[name] for name in ("scanner_1", LATE)}
    found = scanner_pairs._find_differences(rig, tracked, {}, frozenset(), NetworkOptions())
    assert found.inverted == inverted

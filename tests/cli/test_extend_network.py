"""A network measured again: calibrate --extend adds to what is known, check names the scanner that has moved."""

import heapq
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri
from typer.testing import Result

from calgraph.geometry import se2, se3
from calgraph.io.text_writing import save_yaml
from calgraph.recording.writer import RecordingWriter
from calgraph.result import Calibration, load_calibration
from calgraph.sensors import LaserScan
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

Run = Callable[..., Result]

MOVED, STEP = "scanner_2", np.array([0.03, 0.0, 0.0])
EARLIER = "out/calibration.yaml"
_HALF = 25.0


@dataclass(frozen=True, eq=False)
class Halves:
    """rig.yaml, recordings ``first``, ``second`` and ``moved``, calibration of the first; not to be changed."""

    folder: Path
    truth: GroundTruth

    def distance(self, found: Calibration) -> float:
        """Squared Mahalanobis distance of all scanners' poses from the truth."""
        in_plane = np.array([0, 1, 5])
        off = [se3.difference(s.T_root_sensor, self.truth.T_root_sensor[s.name])[in_plane] for s in found.sensors]
        assert found.joint_covariance is not None
        rows = (6 * np.arange(1, len(off))[:, None] + in_plane).ravel()
        error = np.concatenate(off[1:])
        return float(error @ np.linalg.solve(found.joint_covariance[np.ix_(rows, rows)], error))


def scans(network: SimulatedNetwork, name: str) -> Iterator[tuple[float, str, LaserScan]]:
    scanner = next(one for one in network.scanners if one.name == name)
    return ((scan.stamp, f"/{name}/scan", scan) for scan in simulate_scans(network, scanner))


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory, run: Run) -> Halves:
    folder = tmp_path_factory.mktemp("halves")
    network = build_network(
        NetworkScenario(
            scanner={"count": 3, "rate": 10.0, "resolution": 0.5},  # type: ignore[arg-type]
            people={"count": 2},  # type: ignore[arg-type]
            duration=2 * _HALF,
        ),
        seed=100,
    )
    shifted = tuple(
        replace(one, T_world_scanner=se2.retract(one.T_world_scanner, STEP)) if one.name == MOVED else one
        for one in network.scanners
    )
    middle = network.scenario.start_time + _HALF
    rig = network_rig(network)
    topics = {name: spec.topic for name, spec in rig.sensors.items()}
    for recording, source in (
        ("first", network),
        ("second", network),
        ("moved", replace(network, scanners=shifted)),
    ):
        with RecordingWriter(folder / recording) as writer:
            for stamp, name, scan in heapq.merge(*(scans(source, n) for n in topics), key=lambda item: item[0]):
                if (stamp < middle) == (recording == "first"):
                    writer.write(name, scan, stamp)
    save_yaml(folder / "rig.yaml", rig.model_dump(mode="json", exclude_none=True))
    result = run("calibrate", folder / "rig.yaml", folder / "first", "-o", folder / "out")
    assert result.exit_code == 0, result.output
    return Halves(folder, network_truth(network))


def test_two_halves_one_after_the_other_are_as_certain_as_one(halves: Halves, run: Run, tmp_path: Path) -> None:
    """Errors of ranges are the same in both, and dominate; errors of all poses agree with the covariance."""
    old = halves.folder / "out"
    result = run("calibrate", halves.folder / "rig.yaml", halves.folder / "second", "-o", tmp_path / "new",
                 "--extend", old / "calibration.yaml")  # fmt: skip
    assert result.exit_code == 0, result.output
    before, after = (load_calibration(out / "calibration.yaml") for out in (old, tmp_path / "new"))
    np.testing.assert_allclose(deviations(after), deviations(before), rtol=0.15)
    assert halves.distance(after) < chdtri(6, 1e-4)


def deviations(calibration: Calibration) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([np.sqrt(np.trace(sensor.covariance[:2, :2])) for sensor in calibration.sensors[1:]])


def test_no_scanner_has_moved_in_a_network_that_stayed(halves: Halves, run: Run) -> None:
    result = run("check", halves.folder / "rig.yaml", halves.folder / "second", "--against",
                 halves.folder / EARLIER, "--json")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "fail" not in [sensor["outcome"] for sensor in json.loads(result.stdout)["sensors"]]
    assert "has moved" not in result.stdout


def test_a_scanner_that_was_moved_fails_and_no_other(halves: Halves, run: Run) -> None:
    result = run("check", halves.folder / "rig.yaml", halves.folder / "moved", "--against",
                 halves.folder / EARLIER, "--json")  # fmt: skip
    assert result.exit_code == 1, result.output
    audits = {sensor["sensor"]: sensor for sensor in json.loads(result.stdout)["sensors"]}
    assert {name for name, audit in audits.items() if audit["outcome"] == "fail"} == {MOVED}
    far = float(audits[MOVED]["reason"].removeprefix("has moved by ").split(" mm")[0])
    assert far == pytest.approx(30, abs=4)


def test_a_moved_scanner_is_not_mixed_in_but_named(halves: Halves, run: Run, tmp_path: Path) -> None:
    result = run("calibrate", halves.folder / "rig.yaml", halves.folder / "moved", "-o", tmp_path / "new",
                 "--extend", halves.folder / "out/calibration.yaml")  # fmt: skip
    assert result.exit_code == 1
    assert f"{MOVED} has moved by" in result.stderr
    assert f"give --moved: {MOVED}" in result.stderr
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--moved", MOVED], "--moved: goes with --extend"),
        (["--extend", EARLIER, "--estimator", "averaging"], "--extend: goes with --estimator joint"),
        (["--extend", EARLIER, "--moved", "scanner_1"], "--moved: scanner_1 is the root"),
    ],
)
def test_bad_usage_is_refused(
    halves: Halves, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str
) -> None:
    monkeypatch.chdir(halves.folder)
    result = run("calibrate", "rig.yaml", "second", "-o", tmp_path / "new", *options)
    assert result.exit_code == 2
    assert message in result.stderr


def test_the_published_method_is_that_of_its_steps(halves: Halves, run: Run, tmp_path: Path) -> None:
    arguments = ("calibrate", halves.folder / "rig.yaml", halves.folder / "first", "-o")
    steps = "averaging --feature ellipse --average l1mc --weights uniform --icp"
    assert run(*arguments, tmp_path / "whole", "--estimator", "published").exit_code == 0
    assert run(*arguments, tmp_path / "steps", "--estimator", *steps.split()).exit_code == 0
    whole, by_steps = (load_calibration(tmp_path / name / "calibration.yaml") for name in ("whole", "steps"))
    ours = load_calibration(halves.folder / EARLIER)
    assert whole.evidence.estimator == "averaging"
    np.testing.assert_array_equal(whole.joint_covariance, by_steps.joint_covariance)
    np.testing.assert_array_equal(whole[MOVED].T_root_sensor, by_steps[MOVED].T_root_sensor)
    assert not np.array_equal(whole[MOVED].T_root_sensor, ours[MOVED].T_root_sensor)


def test_settings_of_rigs_are_refused(halves: Halves, run: Run, tmp_path: Path) -> None:
    result = run("calibrate", halves.folder / "rig.yaml", halves.folder / "first", "-o", tmp_path / "new",
                 "--tags", "pnp", "--set", "published.keep=none")  # fmt: skip
    assert result.exit_code == 2
    assert result.stderr == "calgraph: published.keep, published.tags: only for rigs with a board\n"

"""Simulated networks: what their scanners send, and the truth that belongs to it."""

from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import load_rig
from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    GroundTruth,
    LayoutName,
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    build_network,
    load_truth,
    network_rig,
    network_truth,
    simulate_network,
    simulate_network_scans,
)

SHORT = NetworkScenario(duration=4.0, scanner=ScannerOptions(resolution=1.0))
EXACT = ScannerOptions(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0)


def office(duration: float = 4.0, people: PeopleOptions | None = None, **scanner: float) -> NetworkScenario:
    return NetworkScenario(
        duration=duration,
        scanner=EXACT.model_copy(update=scanner),
        people=people if people is not None else PeopleOptions(),
    )


def stack(scans: list[LaserScan]) -> Array:
    """(scans, beams) ranges."""
    return np.stack([scan.ranges for scan in scans])


def points_in_root(scan: LaserScan, truth: GroundTruth) -> Array:
    """(N, 2) the scan's points in the root's plane."""
    return se3.apply(truth.T_root_sensor[scan.frame_id], scan.points)[:, :2]


def test_the_same_seed_gives_the_same_scans() -> None:
    (a, _), (b, _) = (simulate_network_scans(SHORT, 4) for _ in range(2))
    assert all(np.array_equal(stack(a[name]), stack(b[name]), equal_nan=True) for name in a)


def test_another_seed_gives_other_poses() -> None:
    a, b = (network_truth(build_network(SHORT, seed)).T_root_sensor["scanner_2"] for seed in (4, 5))
    assert np.linalg.norm(a[:2, 3] - b[:2, 3]) > 0.01


def test_the_root_has_the_identity_pose() -> None:
    truth = network_truth(build_network(SHORT.model_copy(update={"root": "scanner_3"}), 0))
    np.testing.assert_allclose(truth.T_root_sensor["scanner_3"], np.eye(4), atol=1e-12)


def test_number_of_scans_matches_the_rate() -> None:
    scans, _ = simulate_network_scans(SHORT, 0)
    assert all(abs(len(s) - 60) <= 1 for s in scans.values())


def test_scanners_are_not_synchronised() -> None:
    scans, _ = simulate_network_scans(SHORT, 0)
    first = sorted(s[0].stamp for s in scans.values())
    assert np.diff(first).min() > 1e-4


def test_the_time_increment_matches_the_mirror() -> None:
    scans, _ = simulate_network_scans(SHORT, 0)
    scan = scans["scanner_1"][0]
    # 270 degrees of a turn of 1/15 s.
    assert scan.duration == pytest.approx(0.75 / 15, rel=2e-3)


def test_all_scanners_measure_the_same_walls() -> None:
    scans, truth = simulate_network_scans(office(people=PeopleOptions(count=0)), 2)
    points = np.concatenate([points_in_root(s[0], truth) for s in scans.values()])
    outline = build_network(office(), 2)
    T_world_root = next(s.T_world_scanner for s in outline.scanners if s.name == truth.root)
    world = points[np.isfinite(points).all(axis=1)] @ T_world_root[:2, :2].T + T_world_root[:2, 2]
    # Everything is hit on the office's walls or on its furniture, never behind or before them.
    assert np.abs(outline.floor.clearance(world)).max() < 1e-6


def test_points_on_people_lie_on_their_true_ellipses() -> None:
    scenario = office(people=PeopleOptions(count=1))
    scans, truth = simulate_network_scans(scenario, 3)
    empty, _ = simulate_network_scans(office(people=PeopleOptions(count=0)), 3)
    [person] = truth.people
    off = []
    for name, sent in scans.items():
        for scan, background in zip(sent, empty[name], strict=True):
            hit = np.flatnonzero(scan.ranges < background.ranges - 1e-6)
            times = scan.stamp + hit * scan.time_increment
            hit, times = hit[times < person.times[-1]], times[times < person.times[-1]]
            center = np.column_stack([np.interp(times, person.times, person.positions[:, k]) for k in (0, 1)])
            heading = np.interp(times, person.times, np.unwrap(person.headings))
            x, y = (points_in_root(scan, truth)[hit] - center).T
            along, across = np.cos(heading) * x + np.sin(heading) * y, np.cos(heading) * y - np.sin(heading) * x
            off.append(np.hypot(across / person.axes[0], along / person.axes[1]) - 1)
    # The truth is sampled at 20 Hz: what is between its samples is off by about 5 mm of 150 mm at sharp turns.
    assert np.abs(np.concatenate(off)).max() < 0.05


def test_ranges_have_the_stated_noise() -> None:
    quiet = PeopleOptions(count=0)
    exact, _ = simulate_network_scans(office(people=quiet), 1)
    noisy, _ = simulate_network_scans(office(people=quiet, range_noise=0.03), 1)
    error = stack(noisy["scanner_1"]) - stack(exact["scanner_1"])
    assert np.nanstd(error) == pytest.approx(0.03, rel=0.02)


def test_ranges_are_multiples_of_the_quantisation() -> None:
    scans, _ = simulate_network_scans(office(quantisation=0.01), 1)
    steps = stack(scans["scanner_1"]) / 0.01
    assert np.nanmax(np.abs(steps - np.round(steps))) < 1e-6


def test_dropouts_have_the_stated_probability() -> None:
    scans, _ = simulate_network_scans(office(dropout=0.1, max_range=30.0), 1)
    assert np.isnan(stack(scans["scanner_1"])).mean() == pytest.approx(0.1, abs=0.01)


def test_nothing_is_measured_beyond_the_range() -> None:
    scans, _ = simulate_network_scans(office(max_range=5.0, range_noise=0.01), 1)
    assert max(np.nanmax(stack(s)) for s in scans.values()) <= 5.0


def test_stamps_are_late_by_the_clock_offset() -> None:
    (right, _), (wrong, truth) = (simulate_network_scans(office(clock_offset=x), 1) for x in (0.0, 0.03))
    late = {name: wrong[name][0].stamp - right[name][0].stamp for name in right}
    assert late == pytest.approx(dict(truth.clock_offsets), abs=1e-6)


def test_the_roots_clock_is_right() -> None:
    _, truth = simulate_network_scans(office(clock_offset=0.03), 1)
    assert truth.clock_offsets["scanner_1"] == 0.0


def test_the_background_is_without_people() -> None:
    scenario = office().model_copy(update={"background": 2.0})
    scans, _ = simulate_network_scans(scenario, 1)
    spread = [
        np.ptp(stack([s for s in sent if s.stamp < scenario.start_time + 1.9]), axis=0) for sent in scans.values()
    ]
    assert np.nanmax(np.concatenate(spread)) == 0.0


def test_rig_yaml_states_the_background() -> None:
    rig = network_rig(build_network(office().model_copy(update={"background": 2.0}), 0))
    assert rig.capture.background == (0.0, 2.0)


@pytest.mark.parametrize(("layout", "kind"), [("office", "people"), ("ring", "cylinder")])
def test_rig_yaml_states_the_target(layout: LayoutName, kind: str) -> None:
    rig = network_rig(build_network(NetworkScenario(layout=layout, duration=1.0), 0))
    assert not isinstance(rig.target, tuple)
    assert rig.target.kind == kind


def test_the_recording_holds_the_simulated_scans(tmp_path: Path) -> None:
    simulate_network(SHORT, tmp_path, 3)
    scans, _ = simulate_network_scans(SHORT, 3)
    with open_recording(tmp_path / "recording") as recording:
        read = [record.decode() for record in recording.records(topics=["/scanner_2/scan"])]
    assert all(isinstance(scan, LaserScan) for scan in read)
    ranges = stack([scan for scan in read if isinstance(scan, LaserScan)])
    np.testing.assert_allclose(ranges, stack(scans["scanner_2"]), atol=1e-5)


def test_rig_yaml_can_be_read(tmp_path: Path) -> None:
    simulate_network(SHORT, tmp_path, 3)
    assert tuple(load_rig(tmp_path / "rig.yaml").sensors) == SHORT.names
    # Settings stay at the defaults of the version that reads the file.
    assert "settings" not in (tmp_path / "rig.yaml").read_text()


def test_truth_yaml_holds_the_truth(tmp_path: Path) -> None:
    scenario = office(clock_offset=0.03)
    simulate_network(scenario, tmp_path, 3)
    truth, read = network_truth(build_network(scenario, 3)), load_truth(tmp_path / "truth.yaml")
    assert read.clock_offsets == pytest.approx(dict(truth.clock_offsets))
    for a, b in zip(truth.people, read.people, strict=True):
        np.testing.assert_allclose(b.positions, a.positions, atol=1e-5)
        np.testing.assert_allclose(b.times, a.times, atol=1e-6)


def test_progress_ends_at_the_number_of_scans(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    simulate_network(SHORT, tmp_path, 3, lambda done, total: steps.append((done, total)))
    assert steps[-1] == (len(steps), len(steps))


def test_an_earlier_recording_is_not_overwritten(tmp_path: Path) -> None:
    simulate_network(SHORT, tmp_path, 3)
    with pytest.raises(InputError, match="exists already"):
        simulate_network(SHORT, tmp_path, 3)


def test_jitter_into_walls_is_an_error() -> None:
    wild = NetworkScenario(layout="lab", scanner=ScannerOptions(position_jitter=1e4))
    with pytest.raises(InputError, match=r"scanner\.position_jitter: 10000 m puts the scanner"):
        build_network(wild, 0)


def overlaps(layout: LayoutName, seed: int) -> dict[tuple[str, str], float]:
    """By pair of scanners, the fraction of a minute in which both see the same person with three beams."""
    slow = ScannerOptions(**EXACT.model_dump(exclude_unset=True), rate=5.0)
    scenario = NetworkScenario(layout=layout, people=PeopleOptions(count=1), scanner=slow)
    scans, truth = simulate_network_scans(scenario, seed)
    [person] = truth.people
    views = {}
    for name, sent in scans.items():
        times = np.array([scan.stamp + scan.duration / 2 for scan in sent])
        places = np.column_stack([np.interp(times, person.times, person.positions[:, k]) for k in (0, 1)])
        hits = [
            (np.linalg.norm(points_in_root(scan, truth) - place, axis=1) < 0.45).sum()
            for scan, place in zip(sent, places, strict=True)
        ]
        views[name] = np.interp(person.times, times, np.array(hits, dtype=np.float64)) > 2.5
    return {(a, b): float((views[a] & views[b]).mean()) for a, b in combinations(views, 2)}


@pytest.fixture(scope="module")
def in_the_halls() -> dict[tuple[str, str], float]:
    return overlaps("halls", 0)


def test_in_the_halls_scanners_across_have_nothing_in_common(in_the_halls: dict[tuple[str, str], float]) -> None:
    # 1 and 2 are in the halls, 3 and 4 in the corridor: the cycle is 1-2-4-3.
    assert max(in_the_halls["scanner_1", "scanner_4"], in_the_halls["scanner_2", "scanner_3"]) < 0.02


def test_in_the_halls_neighbours_detect_a_person_simultaneously(
    in_the_halls: dict[tuple[str, str], float],
) -> None:
    cycle = [(1, 2), (2, 4), (3, 4), (1, 3)]
    assert min(in_the_halls[f"scanner_{a}", f"scanner_{b}"] for a, b in cycle) > 0.03


def test_in_the_ring_only_neighbours_detect_the_cylinder_simultaneously() -> None:
    names = NetworkScenario(layout="ring").names
    neighbours = {*pairwise(names), (names[0], names[-1])}
    assert {pair for pair, share in overlaps("ring", 0).items() if share > 0.02} == neighbours


def test_scans_arrive_2_to_20_milliseconds_after_their_end_on_the_roots_clock(tmp_path: Path) -> None:
    scenario = office(clock_offset=0.5)
    simulate_network(scenario, tmp_path, 3)
    offset = network_truth(build_network(scenario, 3)).clock_offsets["scanner_2"]
    with open_recording(tmp_path / "recording") as recording:
        records = list(recording.records(topics=["/scanner_2/scan"]))
    scans = [scan for record in records if isinstance(scan := record.decode(), LaserScan)]
    delays = [r.arrival - (s.stamp - offset + s.duration) for r, s in zip(records, scans, strict=True)]
    assert abs(offset) > 0.05
    assert 0.0019 < min(delays) < max(delays) < 0.0201

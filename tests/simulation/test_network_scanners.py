"""Errors of scanners: what each does to the scans, and that the truth states it."""

from typing import Any

import numpy as np
import pytest

from calgraph.geometry import Array, se3
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    GroundTruth,
    NetworkErrors,
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    build_network,
    load_truth,
    network_truth,
    simulate_network,
    simulate_network_scans,
)

EXACT = ScannerOptions(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0, resolution=1.0, max_range=30.0)
EMPTY = PeopleOptions(count=0)


def scenario(people: PeopleOptions = EMPTY, duration: float = 2.0, **errors: Any) -> NetworkScenario:
    return NetworkScenario(duration=duration, scanner=EXACT, people=people, errors=NetworkErrors(**errors))


def simulate(*args: Any, **errors: Any) -> tuple[dict[str, list[LaserScan]], GroundTruth]:
    return simulate_network_scans(scenario(*args, **errors), 2)


def clearance(scans: list[LaserScan], truth: GroundTruth) -> Array:
    """(N,) signed distances from the walls of points measured at the true pose, m."""
    network = build_network(scenario(), 2)
    T_world_root = network.scanners[0].true_pose()
    T_world_sensor = T_world_root @ truth.T_root_sensor[scans[0].frame_id]
    points = np.concatenate([se3.apply(T_world_sensor, scan.points)[:, :2] for scan in scans])
    return np.asarray(network.floor.clearance(points[np.isfinite(points).all(axis=1)]))


@pytest.fixture(scope="module")
def right() -> dict[str, list[LaserScan]]:
    return simulate()[0]


def test_without_errors_the_truth_has_none() -> None:
    assert simulate()[1].errors == {}


def test_a_range_bias_is_added_to_all_ranges(right: dict[str, list[LaserScan]]) -> None:
    scans, truth = simulate(range_bias=0.02)
    for name, sent in scans.items():
        off = sent[0].ranges - right[name][0].ranges
        assert np.nanmax(np.abs(off - truth.errors[name]["range_bias"])) < 1e-12


def test_errors_of_ranges_and_angles_may_be_common_to_all_scanners() -> None:
    """A share of 0.75 of their variance leaves half of each scanner's part."""
    sizes = {"range_bias": 0.02, "range_scale": 0.01, "angle_scale": 0.01}
    [apart, mixed, common] = [
        [list(one.values()) for one in simulate(**sizes, common_share=share)[1].errors.values()]
        for share in (0.0, 0.75, 1.0)
    ]
    assert np.ptp(apart, axis=0).min() > 1e-3
    np.testing.assert_allclose(np.ptp(common, axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(np.ptp(mixed, axis=0), np.ptp(apart, axis=0) / 2)


def test_a_range_scale_multiplies_all_ranges(right: dict[str, list[LaserScan]]) -> None:
    scans, truth = simulate(range_scale=0.01)
    for name, sent in scans.items():
        ratio = sent[0].ranges / right[name][0].ranges
        assert np.nanmax(np.abs(ratio - 1 - truth.errors[name]["range_scale"])) < 1e-12


def test_an_angle_scale_turns_beams_away_from_the_middle() -> None:
    scans, truth = simulate(angle_scale=0.01)
    sent, off = scans["scanner_2"], truth.errors["scanner_2"]["angle_scale"]
    scan = sent[0]
    corrected = LaserScan(scan.stamp, scan.frame_id, (1 + off) * scan.angles, scan.ranges, scan.time_increment)
    assert np.abs(clearance([scan], truth)).max() > 0.005
    assert np.abs(clearance([corrected], truth)).max() < 1e-6


def test_tilted_beams_reach_walls_farther_away(right: dict[str, list[LaserScan]]) -> None:
    scans, truth = simulate(tilt=2.0)
    name, sent = "scanner_3", scans["scanner_3"]
    x, y = (truth.errors[name][axis] for axis in ("tilt_x", "tilt_y"))
    slope = x * np.sin(sent[0].angles) - y * np.cos(sent[0].angles)
    hits = sent[0].ranges / right[name][0].ranges
    # Where the beam falls on the same wall; others pass an edge.
    np.testing.assert_allclose(np.median(hits - 1 - slope**2 / 2), 0, atol=1e-3)


def test_tilted_scanners_of_legs_measure_the_floor() -> None:
    legs = PeopleOptions(count=0, shape="legs")
    scans, truth = simulate(legs, tilt=6.0)
    on_floor = 0
    for name, [scan, *_] in scans.items():
        x, y = (truth.errors[name][axis] for axis in ("tilt_x", "tilt_y"))
        slope = x * np.sin(scan.angles) - y * np.cos(scan.angles)
        floor = np.where(slope < -1e-3, 0.3 / np.maximum(-slope, 1e-3), np.inf)
        assert (scan.ranges < floor * 1.02)[np.isfinite(scan.ranges)].all()
        on_floor += int(np.isclose(scan.ranges, floor, rtol=0.02).sum())
    assert on_floor > 50


def test_legs_are_cut_at_the_height_of_the_scanner() -> None:
    people = PeopleOptions(shape="legs", count=1)
    (level, _), (raised, truth) = (
        simulate_network_scans(scenario(people, 10.0, height=height), 2) for height in (0.0, 0.15)
    )
    offsets = [T[2, 3] for T in truth.T_root_sensor.values()]
    assert 0.05 < np.ptp(offsets) < 0.3
    moved = [
        np.nanmax(np.abs(a.ranges - b.ranges))
        for name in level
        for a, b in zip(level[name], raised[name], strict=True)
    ]
    assert max(moved) > 0.05


def test_inverted_scanners_measure_the_same_walls() -> None:
    scans, truth = simulate(inverted=2)
    upside_down = [name for name in scans if truth.errors.get(name, {}).get("inverted")]
    assert len(upside_down) == 2
    for name in upside_down:
        assert truth.T_root_sensor[name][2, 2] == pytest.approx(-1)
        assert np.abs(clearance(scans[name][:1], truth)).max() < 1e-6


def test_the_root_is_never_inverted() -> None:
    networks = [build_network(scenario(inverted=3), seed) for seed in range(10)]
    assert not any(network.scanners[0].inverted for network in networks)


def test_an_inverted_root_has_the_others_upside_down() -> None:
    network = build_network(scenario(flip_root=True), 2)
    truth = network_truth(network)
    assert [T[2, 2] for T in truth.T_root_sensor.values()] == pytest.approx([1, -1, -1, -1, -1, -1])
    scans, _ = simulate_network_scans(network.scenario, 2)
    T_world_root = network.scanners[0].true_pose()
    for name, sent in scans.items():
        points = se3.apply(T_world_root @ truth.T_root_sensor[name], sent[0].points)[:, :2]
        assert np.abs(network.floor.clearance(points[np.isfinite(points).all(axis=1)])).max() < 1e-6


def test_all_but_the_root_can_be_inverted_at_most() -> None:
    with pytest.raises(ValueError, match="must be below the number of scanners, 6"):
        scenario(inverted=6)


def test_clocks_drift_by_the_stated_rate(right: dict[str, list[LaserScan]]) -> None:
    scans, truth = simulate(clock_drift=1000.0)
    for name, sent in scans.items():
        off = np.array([b.stamp - a.stamp for a, b in zip(right[name], sent, strict=True)])
        drift = truth.errors.get(name, {}).get("clock_drift", 0.0)
        assert off[-1] - off[0] == pytest.approx(drift * (sent[-1].stamp - sent[0].stamp), rel=0.01)


def test_clock_offsets_are_those_of_the_middle() -> None:
    network = build_network(scenario(duration=10.0, clock_drift=1000.0), 2)
    scans, truth = simulate_network_scans(network.scenario, 2)
    for scanner in network.scanners:
        starts = scanner.phase + scanner.period * np.arange(len(scans[scanner.name]))
        off = [scan.stamp - 1.7e9 - start for scan, start in zip(scans[scanner.name], starts, strict=True)]
        assert np.interp(5.0, starts, off) == pytest.approx(truth.clock_offsets[scanner.name], abs=1e-6)


def test_mixed_scanners_differ() -> None:
    scans, _ = simulate(mixed=True)
    assert len({len(sent) for sent in scans.values()}) >= 3
    assert len({len(sent[0].ranges) for sent in scans.values()}) == 3


def test_after_a_bump_the_truth_is_the_new_pose() -> None:
    scans, truth = simulate(bump_turn=3.0, bump_shift=0.03)
    [name] = truth.errors
    bump = truth.errors[name]["bump"]
    assert np.degrees(abs(bump["rotation"])) == pytest.approx(3.0)
    assert np.linalg.norm(bump["translation"]) == pytest.approx(0.03)
    late = [scan for scan in scans[name] if scan.stamp > 1.7e9 + bump["time"]]
    if name == truth.root:
        pytest.skip("the world of this test is that of the root at the start")
    assert np.abs(clearance(late, truth)).max() < 1e-6
    assert np.abs(clearance(scans[name][:1], truth)).max() > 0.01


def test_the_pose_before_a_bump_and_its_motion_give_the_pose_after_it() -> None:
    still, bumped = (network_truth(build_network(scenario(bump_turn=x), 2)) for x in (0.0, 10.0))
    [name] = bumped.errors
    motion = still.T_root_sensor[name][:3, :3].T @ bumped.T_root_sensor[name][:3, :3]
    if name != bumped.root:
        assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(bumped.errors[name]["bump"]["rotation"])


def test_a_driving_scanner_sees_other_walls_all_the_time() -> None:
    scans, truth = simulate(EMPTY, 10.0, driving=0.5)
    [name] = truth.errors
    assert truth.errors[name] == {"driving": True}
    seconds = np.stack([scan.ranges for scan in scans[name]])[::15]
    assert np.median(np.nanmedian(np.abs(np.diff(seconds, axis=0)), axis=1)) > 0.05
    assert name != truth.root


def test_errors_do_not_change_the_building_or_the_walks() -> None:
    people = PeopleOptions(count=1)
    a, b = (build_network(scenario(people, range_bias=x, tilt=x, driving=x), 2) for x in (0.0, 0.5))
    np.testing.assert_array_equal(a.walks[0].positions, b.walks[0].positions)
    np.testing.assert_array_equal(a.scanners[0].T_world_scanner, b.scanners[0].T_world_scanner)


def test_truth_yaml_holds_the_errors(tmp_path: Any) -> None:
    wrong = scenario(range_bias=0.02, tilt=1.0, bump_turn=3.0, inverted=1, clock_drift=20.0)
    simulate_network(wrong, tmp_path, 2)
    assert load_truth(tmp_path / "truth.yaml").errors == network_truth(build_network(wrong, 2)).errors


def test_people_are_where_an_inverted_scanner_measures_them() -> None:
    people = PeopleOptions(count=1)
    empty, _ = simulate(inverted=2)
    scans, truth = simulate(people, inverted=2)
    [person] = truth.people
    for name in scans:
        for scan, background in zip(scans[name], empty[name], strict=True):
            hit = scan.ranges < background.ranges - 1e-6
            if hit.any():
                place = [np.interp(scan.stamp, person.times, person.positions[:, k]) for k in (0, 1)]
                points = se3.apply(truth.T_root_sensor[name], scan.points)[hit][:, :2]
                assert np.linalg.norm(points.mean(axis=0) - place) < 0.5

"""What moved between recordings: which sensor, when, how far, and what both recordings share."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import ChangeRules
from calgraph.fleet.changes import PosePair, compare_poses, pair_recordings
from calgraph.fleet.recording_result import PoseSet
from calgraph.fleet.run import collect_robots
from calgraph.geometry import Array
from calgraph.result import PriorErrors
from fleet_scenes import NAMES, draw_poses, make_robot, measure_poses

RULES = ChangeRules()
CHANCE = 1e-4
STEP = np.array([0.006, 0.0, -0.008, 0.0, 0.0, 0.0])


def pair(before: PoseSet, after: PoseSet) -> PosePair:
    return PosePair("previous", "day-0", "day-1", before, after)


@pytest.mark.parametrize("sensor", NAMES)
def test_the_moved_sensor_is_named_even_if_it_is_the_root(sensor: str) -> None:
    for seed in range(10):
        rng, T = np.random.default_rng(seed), draw_poses(seed)
        sets = [measure_poses(T, rng, moved, 5e-4) for moved in ({}, {sensor: STEP})]
        found = compare_poses(pair(*sets), RULES, CHANCE)
        (move,) = found.moves
        assert move.sensors == (sensor,)
        assert abs(move.distance - 0.01) < 4 * move.distance_stddev


def test_an_unmoved_robot_has_changes_within_their_standard_deviations() -> None:
    rng, T = np.random.default_rng(0), draw_poses()
    found = compare_poses(pair(measure_poses(T, rng), measure_poses(T, rng)), RULES, CHANCE)
    assert found.moves == ()
    assert [change.sensor for change in found.changes] == ["camera", "laser"]
    for change in found.changes:
        assert change.stddev == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-3)
        assert np.abs(change.step / change.stddev).max() < 4


def test_a_significant_change_below_the_minimum_is_no_move() -> None:
    rng, T = np.random.default_rng(0), draw_poses()
    sets = [measure_poses(T, rng, moved, 1e-5) for moved in ({}, {"camera": 0.1 * STEP})]
    assert compare_poses(pair(*sets), RULES, CHANCE).moves == ()
    finer = ChangeRules(min_translation=0.0005)
    assert [move.sensors for move in compare_poses(pair(*sets), finer, CHANCE).moves] == [("camera",)]


def with_prior_errors(poses: PoseSet, size: float) -> PoseSet:
    """The poses with an error of all x that a stated value explains, with this standard deviation."""
    errors = np.zeros((18, 1))
    errors[[6, 12]] = size
    shared = PriorErrors((("board", "print scale"),), errors)
    return PoseSet(poses.names, poses.T_root_sensor, poses.covariance + errors @ errors.T, shared)


@pytest.mark.parametrize(("common", "stddev"), [(1.0, 1.414e-3), (0.0, 14.21e-3), (0.95, 3.464e-3)])
def test_what_recordings_share_is_no_error_of_their_difference(common: float, stddev: float) -> None:
    """Of a variance of (10 mm)² of each, 5 % differ: (1.41 mm)² + 2 · 0.05 · (10 mm)²."""
    rng, T = np.random.default_rng(0), draw_poses()
    sets = [with_prior_errors(measure_poses(T, rng), 0.01) for _ in range(2)]
    found = compare_poses(pair(*sets), ChangeRules(common_variance=common), CHANCE)
    assert found.changes[0].stddev[0] == pytest.approx(stddev, rel=1e-3)
    assert found.changes[0].stddev[1] == pytest.approx(1.414e-3, rel=1e-3)


def test_of_two_sensors_both_are_named() -> None:
    rng, T = np.random.default_rng(0), draw_poses()
    sets = [measure_poses(T, rng, moved).select(NAMES[:2]) for moved in ({}, {"camera": STEP})]
    (move,) = compare_poses(pair(*sets), RULES, CHANCE).moves
    assert set(move.sensors) == {"lidar", "camera"}


def as_network(poses: PoseSet) -> PoseSet:
    """The same without height and tilt."""
    covariance = poses.covariance.copy()
    rows = [6 * k + axis for k in (1, 2) for axis in (2, 3, 4)]
    covariance[rows] = covariance[:, rows] = np.nan
    return PoseSet(poses.names, poses.T_root_sensor, covariance)


def test_a_network_is_compared_in_its_plane() -> None:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1:, :2, 3] = [[3.0, 1.0], [-2.0, 4.0]]
    height, step = np.array([0, 0, 0.5, 0, 0, 0]), np.array([0.03, 0.04, 0, 0, 0, 0.02])
    sets = [as_network(measure_poses(T, rng, moved)) for moved in ({}, {"camera": step, "laser": height})]
    (move,) = compare_poses(pair(*sets), RULES, CHANCE).moves
    assert move.sensors == ("camera",)
    assert move.distance == pytest.approx(0.05, abs=0.008)
    assert move.angle == pytest.approx(0.02, abs=0.006)


def test_sensors_without_a_finite_covariance_are_not_compared() -> None:
    rng, T = np.random.default_rng(0), draw_poses()
    sets = []
    for moved in ({}, {"camera": STEP}):
        poses = measure_poses(T, rng, moved)
        poses.covariance[12:, 12:] = np.inf
        sets.append(poses)
    found = compare_poses(pair(*sets), RULES, CHANCE)
    assert set(found.moves[0].sensors) == {"camera", "lidar"}


def drifting(steps: list[Array]) -> list[PoseSet]:
    rng, T = np.random.default_rng(1), draw_poses()
    return [measure_poses(T, rng, {"camera": step}) for step in steps]


def test_a_step_is_named_once_between_the_recordings_where_it_happened(tmp_path: Path) -> None:
    plan, results = make_robot(tmp_path, "a", drifting([0 * STEP, 0 * STEP, STEP, STEP]))
    (robot,) = collect_robots([plan], results, RULES)
    ((comparison, move),) = robot.moves
    assert (comparison.earlier, comparison.later, move.sensors) == ("day-1", "day-2", ("camera",))


def test_a_slow_drift_is_named_since_the_first_recording(tmp_path: Path) -> None:
    plan, results = make_robot(tmp_path, "a", drifting([share * STEP for share in np.linspace(0, 1.2, 7)]))
    (robot,) = collect_robots([plan], results, RULES)
    ((comparison, _),) = robot.moves
    assert (comparison.since, comparison.earlier) == ("first", "day-0")


def test_a_failed_recording_is_passed_over(tmp_path: Path) -> None:
    plan, results = make_robot(tmp_path, "a", drifting([0 * STEP, 0 * STEP, STEP]))
    del results[plan.tasks[1]]
    ((compared),) = pair_recordings(list(results.values()))
    assert (compared.earlier, compared.later) == ("day-0", "day-2")


def test_false_alarms_of_a_whole_fleet_are_as_rare_as_stated(tmp_path: Path) -> None:
    """40 fleets of 10 robots at 20 %: 8 false alarms, with three standard deviations of 7.6."""
    rules = ChangeRules(false_alarm_probability=0.2, min_translation=1e-6)
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(40):
        made = [
            make_robot(tmp_path, str(k), [measure_poses(draw_poses(k), rng) for _ in range(2)]) for k in range(10)
        ]
        results = {task: result for _, of_robot in made for task, result in of_robot.items()}
        alarms += any(robot.moves for robot in collect_robots([plan for plan, _ in made], results, rules))
    assert abs(alarms - 8) < 8

"""Live solutions: an answer for any captures, and the numbers of a calibration."""

import pickle
import re
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.live.rig_solution import LiveSolution, solve_captures
from calgraph.live.sensor_solution import SensorSolution
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import LaserOptions, RigScenario, SpinningOptions, build_world
from ideal_detections import simulate_detections

SCENARIO = RigScenario(
    laser=LaserOptions(count=2, resolution=0.5),
    spinning=SpinningOptions(resolution=1.0, scans_per_degree=1 / 6),
    bearings=(-45, 20, -20, 45, 0, -30, 30, 10),
    samples=1,
)


@pytest.fixture(scope="module")
def simulated() -> tuple[Rig, CaptureSet]:
    rig, captures, _ = simulate_detections(build_world(SCENARIO, 4, images=False), 0)
    return rig, captures


@pytest.fixture(scope="module")
def solved(simulated: tuple[Rig, CaptureSet]) -> LiveSolution:
    return solve_captures(*simulated)


@pytest.fixture(scope="module")
def calibrated(simulated: tuple[Rig, CaptureSet]) -> Calibration:
    rig, captures = simulated
    problem = build_problem_from_captures(rig, captures, RigOptions(folds=0), np.random.default_rng(0))
    return solve_problem(problem)


def select(captures: CaptureSet, chosen: Collection[int]) -> CaptureSet:
    """Some of the captures."""
    return replace(
        captures,
        holds=tuple(hold for hold in captures.holds if hold.index in chosen),
        detections={
            name: {capture: found for capture, found in by_capture.items() if capture in chosen}
            for name, by_capture in captures.detections.items()
        },
    )


def by_name(solution: LiveSolution) -> dict[str, SensorSolution]:
    return {sensor.name: sensor for sensor in solution.sensors}


def pose_error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max())


def test_poses_are_those_of_a_calibration(solved: LiveSolution, calibrated: Calibration) -> None:
    for sensor in calibrated.sensors[1:]:
        T = by_name(solved)[sensor.name].T_root_sensor
        assert T is not None
        off = (T[:3, 3] - sensor.T_root_sensor[:3, 3]) / np.sqrt(np.diag(sensor.covariance)[:3])
        assert np.abs(off).max() < 0.1


def test_standard_deviations_along_axes_are_those_of_a_calibration(
    solved: LiveSolution, calibrated: Calibration
) -> None:
    for sensor in calibrated.sensors[1:]:
        R = sensor.T_root_sensor[:3, :3]
        blocks = [R.T @ sensor.covariance[i : i + 3, i : i + 3] @ R for i in (0, 3)]
        expected = np.sqrt(np.concatenate([np.diag(block) for block in blocks]))
        np.testing.assert_allclose(by_name(solved)[sensor.name].stddev, expected, rtol=0.03)


def test_solution_that_starts_from_an_earlier_one_has_the_same_poses(
    simulated: tuple[Rig, CaptureSet], solved: LiveSolution
) -> None:
    rig, captures = simulated
    earlier = solve_captures(rig, select(captures, range(len(captures.holds) - 2)))
    warm = by_name(solve_captures(rig, captures, earlier))
    for name, sensor in by_name(solved).items():
        T, expected = warm[name].T_root_sensor, sensor.T_root_sensor
        assert T is not None
        assert expected is not None
        off = expected[:3, :3].T @ (T[:3, 3] - expected[:3, 3])
        assert np.all(np.abs(off) <= 0.1 * sensor.stddev[:3])
        np.testing.assert_allclose(warm[name].stddev, sensor.stddev, rtol=0.03)


def test_wrong_poses_of_an_earlier_solution_are_replaced(
    simulated: tuple[Rig, CaptureSet], solved: LiveSolution
) -> None:
    shifted = [
        sensor if sensor.name != "camera" else replace(sensor, T_root_sensor=np.eye(4))
        for sensor in solved.sensors
    ]
    again = by_name(solve_captures(*simulated, replace(solved, sensors=tuple(shifted))))["camera"]
    expected = by_name(solved)["camera"]
    assert again.T_root_sensor is not None
    assert expected.T_root_sensor is not None
    np.testing.assert_allclose(again.T_root_sensor[:3, 3], expected.T_root_sensor[:3, 3], atol=1e-3)


def test_the_scene_has_sensors_the_boards_of_all_captures_and_the_next_one(
    simulated: tuple[Rig, CaptureSet], solved: LiveSolution
) -> None:
    rig, captures = simulated
    assert solved.scene is not None
    assert [sensor.name for sensor in solved.scene.sensors] == list(rig.sensors)
    boards = np.array(solved.scene.boards)
    assert len(boards) == len(captures.holds)
    sides = np.linalg.norm(np.diff(boards, axis=1), axis=2)
    # Boards that only a scanner detected are as large as the points on them.
    np.testing.assert_allclose(np.median(sides, axis=0), [*rig.board_size, rig.board_size[0]], atol=1e-6)
    assert solved.suggestion is not None
    assert solved.scene.suggested is not None
    np.testing.assert_allclose(
        solved.scene.suggested.mean(axis=0), solved.suggestion.T_root_board[:3, 3], atol=1e-9
    )
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(solved.scene.suggested, axis=0), axis=1), np.median(sides, axis=0), atol=1e-6
    )


def test_grades_are_those_of_a_calibration(solved: LiveSolution, calibrated: Calibration) -> None:
    grades = {sensor.name: sensor.verdict.grade for sensor in calibrated.sensors}
    assert {name: sensor.grade for name, sensor in by_name(solved).items()} == grades


def test_progress_is_the_share_of_the_tolerance(simulated: tuple[Rig, CaptureSet], solved: LiveSolution) -> None:
    tolerance = simulated[0].tolerance
    for sensor in solved.sensors:
        if sensor.stddev.any():
            share = np.min(tolerance.limits / 1.96 / sensor.stddev)
            assert sensor.progress == pytest.approx(min(share, 1.0), rel=1e-3)


def test_solution_is_done_where_all_sensors_are_within_tolerance(simulated: tuple[Rig, CaptureSet]) -> None:
    rig, captures = simulated
    wide = rig.model_copy(
        update={"tolerance": rig.tolerance.model_copy(update={"translation": 0.1, "rotation": 3})}
    )
    solution = solve_captures(wide, captures)
    assert solution.done
    assert [sensor.progress for sensor in solution.sensors] == [1.0] * 4
    assert solution.advice is None


def test_weak_sensors_have_the_largest_source_and_a_remedy_with_its_error(
    simulated: tuple[Rig, CaptureSet],
) -> None:
    rig, captures = simulated
    strict = rig.model_copy(
        update={"tolerance": rig.tolerance.model_copy(update={"translation": 0.002, "rotation": 0.05})}
    )
    weak = [sensor for sensor in solve_captures(strict, captures).sensors if sensor.grade == "weak"]
    assert len(weak) == 3
    for sensor in weak:
        assert re.search(r"the largest sources? of .*; record \d+ more captures like these: .* ±", sensor.reason)


def test_no_captures_give_advice_for_the_first_pair(simulated: tuple[Rig, CaptureSet]) -> None:
    rig, captures = simulated
    solution = solve_captures(rig, select(captures, ()))
    assert solution.advice is not None
    assert solution.advice.text.startswith("Show the board to camera and lidar together, in several places")
    assert all(sensor.T_root_sensor is None for sensor in solution.sensors if sensor.name != "lidar")
    assert {sensor.progress for sensor in solution.sensors} == {0.0}


def test_sensors_without_common_captures_have_no_pose(simulated: tuple[Rig, CaptureSet]) -> None:
    rig, captures = simulated
    alone = {name: {list(by)[k]: list(by.values())[k]} for k, (name, by) in enumerate(captures.detections.items())}
    solution = solve_captures(rig, replace(captures, detections=alone))
    assert by_name(solution)["camera"].T_root_sensor is None
    assert not solution.done


def test_cameras_without_intrinsics_wait(simulated: tuple[Rig, CaptureSet]) -> None:
    rig, captures = simulated
    solution = solve_captures(rig, replace(captures, cameras={}))
    assert by_name(solution)["camera"].T_root_sensor is None
    assert by_name(solution)["laser_front"].T_root_sensor is not None


def test_solutions_are_sent_between_processes(solved: LiveSolution) -> None:
    received = pickle.loads(pickle.dumps(solved))  # noqa: S301
    np.testing.assert_array_equal(received.sensors[0].T_root_sensor, solved.sensors[0].T_root_sensor)

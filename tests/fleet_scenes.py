"""Results of recordings of a fleet, made without recordings."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calgraph.fleet.plan import RecordingTask, RobotPlan
from calgraph.fleet.recording_result import PoseSet, RecordingResult, SensorResult
from calgraph.geometry import Array, se3, so3

NAMES = ("lidar", "camera", "laser")


def draw_poses(seed: int = 0) -> Array:
    """(3, 4, 4) poses of a robot's sensors, the root's first."""
    rng = np.random.default_rng(seed)
    T = se3.pose(so3.exp(rng.uniform(-2, 2, (3, 3))), rng.uniform(-0.5, 0.5, (3, 3)))
    T[0] = np.eye(4)
    return T


def measure_poses(
    T: Array, rng: np.random.Generator, moved: Mapping[str, Array] | None = None, stddev: float = 1e-3
) -> PoseSet:
    """Estimated poses after some sensors have moved, with independent errors along all axes, m and rad."""
    after = T.copy()
    for name, step in (moved or {}).items():
        k = NAMES.index(name)
        after[k] = se3.retract(after[k], step)
    error = rng.normal(0, stddev, (3, 6))
    error[0] = 0
    covariance = stddev**2 * np.eye(18)
    covariance[:6] = 0
    return PoseSet(NAMES, se3.retract(se3.inverse(after[0]) @ after, error), covariance)


def make_task(out: Path, robot: str = "a", recording: str = "day-0", key: str = "key") -> RecordingTask:
    """A task whose inputs do not exist."""
    missing = out / "missing"
    folder = out / "robots" / robot / recording
    return RecordingTask(robot, recording, "calibrate", missing, missing, None, folder, 0, key)


def make_result(task: RecordingTask, poses: PoseSet) -> RecordingResult:
    """The result of a task, all sensors good."""
    sensors = tuple(SensorResult(name, "lidar3d", "good") for name in poses.names)
    return RecordingResult(
        task.robot, task.recording, str(task.path), task.key, 1.5, start=1.7e9, duration=30.0, sensors=sensors,
        poses=poses,
    )  # fmt: skip


def make_robot(
    out: Path, robot: str, poses: list[PoseSet]
) -> tuple[RobotPlan, dict[RecordingTask, RecordingResult]]:
    """A robot with a recording per set of poses, and its results."""
    tasks = tuple(make_task(out, robot, f"day-{number}") for number in range(len(poses)))
    return RobotPlan(robot, tasks), {task: make_result(task, of) for task, of in zip(tasks, poses, strict=True)}

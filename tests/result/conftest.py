"""A calibration with every kind of content, and poses drawn at random."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.result import (
    BoardOutline,
    Calibration,
    CaptureRow,
    Edge,
    ErrorBudget,
    ErrorSource,
    Evidence,
    Pictures,
    SensorPose,
    Verdict,
    join_covariances,
)


def random_pose(rng: np.random.Generator) -> Array:
    return se3.pose(so3.exp(rng.normal(0, 1.5, 3)), rng.uniform(-3, 3, 3))


def random_covariance(rng: np.random.Generator) -> Array:
    root = rng.normal(0, 1, (6, 6)) * np.array([3e-3, 3e-3, 3e-3, 1e-3, 1e-3, 1e-3])[:, None]
    covariance: Array = root @ root.T
    return covariance


@pytest.fixture
def calibration(rng: np.random.Generator) -> Calibration:
    root = SensorPose("lidar", None, "velodyne", "lidar3d", np.eye(4), Verdict("good"))
    camera = SensorPose(
        "camera", "lidar", "camera_optical", "camera", random_pose(rng), Verdict("good"),
        clock_offset=0.0123, clock_offset_stddev=0.0004,
    )  # fmt: skip
    second = SensorPose("camera_2", "camera", "camera_2_optical", "camera", random_pose(rng), Verdict("good"))
    weak = Verdict("weak", "height (z) is loose: hold the board tilted, above and below the scan plane")
    laser = SensorPose("laser", "lidar", "laser_link", "lidar2d", random_pose(rng), weak)
    return Calibration(
        root="lidar",
        sensors=(root, camera, second, laser),
        joint_covariance=join_covariances([np.zeros((6, 6)), *(random_covariance(rng) for _ in range(3))]),
        evidence=Evidence(
            edges=(
                Edge("lidar", "camera", 40, 38, True, rng.normal(0, 0.004, 38)),
                Edge("lidar", "laser", 30, 25, True, rng.normal(0, 0.006, 25)),
                Edge("camera", "camera_2", 20, 20, True, rng.normal(0, 0.002, 20)),
                Edge("camera", "laser", 3, 0, False, np.empty(0), "needs 5 captures, has 3"),
            ),
            captures=(
                CaptureRow(0, 1.5, 4.0, "lidar", True, "", 0.004),
                CaptureRow(0, 1.5, 4.0, "camera", False, 'no tag found, "glare", maybe'),
                CaptureRow(1, 6.25, 8.0, "lidar", True, "", 0.002),
                CaptureRow(1, 6.25, 8.0, "camera", True, "", 0.003),
            ),
            unconnected={"sonar": "never saw the board together with another sensor"},
            residuals={"plane-plane": rng.normal(0, 1.1, 300), "plane-line": rng.normal(0, 0.9, 200)},
            estimator="bundle",
        ),
        pictures=Pictures(board_outlines=(BoardOutline(0, rng.normal(0, 1, (4, 3))),)),
    )


@pytest.fixture
def budgeted(calibration: Calibration, rng: np.random.Generator) -> Calibration:
    """The same with correlations, and three sources that they come from."""
    roots = rng.normal(0, 1, (3, 24, 30)) * np.tile([3e-3] * 3 + [1e-3] * 3, 4)[:, None]
    roots[:, :6] = 0.0
    covariance = roots @ roots.transpose(0, 2, 1)
    sources = ErrorSource("noise", "camera"), ErrorSource("range bias", "lidar"), ErrorSource("drift")
    budget = ErrorBudget.of_poses(sources, covariance, [one.T_root_sensor for one in calibration.sensors])
    return replace(calibration, joint_covariance=covariance.sum(axis=0), budget=budget)


@pytest.fixture
def planar(budgeted: Calibration) -> Calibration:
    """Three scanners of a network and a root, one pair of which has an edge, with the same sources."""
    unmeasured = (6 * np.arange(1, 4)[:, None] + [2, 3, 4]).ravel()
    assert budgeted.budget is not None
    assert budgeted.budget.covariance is not None
    covariance = budgeted.budget.covariance.copy()
    covariance[:, unmeasured] = covariance[:, :, unmeasured] = np.nan
    stddev = budgeted.budget.stddev.copy()
    stddev[..., [2, 3, 4]] = 0.0
    sensors = [replace(one, kind="lidar2d", T_root_sensor=np.eye(4)) for one in budgeted.sensors]
    for sensor, yaw in zip(sensors[1:], (0.4, -2.0, 3.0), strict=True):
        sensor.T_root_sensor[:] = se3.pose(so3.exp(np.array([0, 0, yaw])), np.array([3 * yaw, 1.0, 0]))
    edges = (
        Edge("laser", "camera", 9, 8, False, np.empty(0)),
        Edge("camera", "camera_2", 9, 0, False, np.empty(0)),
    )
    budget = ErrorBudget(budgeted.budget.sources, stddev, covariance)
    total = covariance.sum(axis=0)
    return Calibration("lidar", tuple(sensors), total, evidence=Evidence(edges=edges), budget=budget)

"""Error budgets of poses."""

import numpy as np
import pytest

from calgraph.geometry import se3, so3
from calgraph.result import Calibration, ErrorBudget, ErrorSource, SensorPose, Verdict

SOURCES = (ErrorSource("noise", "camera"), ErrorSource("print scale", "board"))
T_ROOT_CAMERA = se3.pose(so3.exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 0.2, -0.3]))
T_ROOT_LASER = se3.pose(so3.exp(np.array([0.3, 0.0, 0.5])), np.array([0.0, 2.0, 0.1]))


@pytest.fixture
def budget() -> ErrorBudget:
    rng = np.random.default_rng(0)
    parts = np.zeros((2, 18, 18))
    for part in parts:
        A = 1e-3 * rng.standard_normal((12, 12))
        part[6:, 6:] = A @ A.T
    return ErrorBudget.of_poses(SOURCES, parts, [np.eye(4), T_ROOT_CAMERA, T_ROOT_LASER])


def test_standard_deviations_are_along_the_axes_of_the_sensor(budget: ErrorBudget) -> None:
    """The camera is turned by 90° about z: its x axis is the root's y axis."""
    assert budget.covariance is not None
    variance = budget.covariance[0]
    assert budget.stddev[0, 1, 0] == pytest.approx(np.sqrt(variance[7, 7]))
    assert budget.stddev[0, 1, 1] == pytest.approx(np.sqrt(variance[6, 6]))


def test_shares_of_an_axis_add_up_to_one_and_those_of_the_root_are_zero(budget: ErrorBudget) -> None:
    np.testing.assert_allclose(budget.shares(2).sum(axis=0), 1)
    assert not budget.shares(0).any()


def test_sources_of_a_relative_pose_add_up_to_its_covariance(budget: ErrorBudget) -> None:
    assert budget.covariance is not None
    verdict = Verdict("good")
    sensors = (
        SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), verdict),
        SensorPose("camera", "lidar", "camera", "camera", T_ROOT_CAMERA, verdict),
        SensorPose("laser", "lidar", "laser", "lidar2d", T_ROOT_LASER, verdict),
    )
    calibration = Calibration("lidar", sensors, budget.covariance.sum(axis=0), budget=budget)
    parts = budget.relative_covariances(1, 2, T_ROOT_CAMERA, T_ROOT_LASER)
    np.testing.assert_allclose(parts.sum(axis=0), calibration.covariance("camera", "laser"), atol=1e-15)

"""A calibration with every kind of content, and poses drawn at random."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.result import (
    BoardOutline,
    Calibration,
    CaptureRow,
    Edge,
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

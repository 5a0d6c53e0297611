"""Calibrations of networks with given poses and covariance."""

import numpy as np

from calgraph.geometry import se2
from calgraph.network.joint.planar_poses import NetworkPoses, lift_covariance
from calgraph.result import Calibration, SensorPose, Verdict


def four_scanners(rng: np.random.Generator) -> NetworkPoses:
    """Random poses in the frame of the first scanner, with correlated errors."""
    T = se2.pose(rng.uniform(-3, 3, 4), rng.uniform(-5, 5, (4, 2)))
    T[0] = np.eye(3)
    mixed = rng.normal(0, 0.01, (12, 12))
    mixed[:3] = 0
    return NetworkPoses(("a", "b", "c", "d"), T, mixed @ mixed.T)


def calibration(poses: NetworkPoses) -> Calibration:
    """A calibration with these poses; the parent of each scanner is the one before it."""
    T, covariance = se2.to_se3(poses.T_root_scanner), lift_covariance(poses.covariance)
    sensors = tuple(
        SensorPose(n, poses.names[k - 1] if k else None, n, "lidar2d", T[k], Verdict("good"))
        for k, n in enumerate(poses.names)
    )
    return Calibration("a", sensors, joint_covariance=covariance)

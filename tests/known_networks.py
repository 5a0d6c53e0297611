"""Networks of which only the poses are known, and how sure they are."""

import numpy as np

from calgraph.estimation.network.planar_poses import PlanarPoses
from calgraph.geometry import se2
from calgraph.result import Calibration, SensorPose, Verdict


def four_scanners(rng: np.random.Generator) -> PlanarPoses:
    """Anywhere in the frame of the first, with errors that go together."""
    T = se2.pose(rng.uniform(-3, 3, 4), rng.uniform(-5, 5, (4, 2)))
    T[0] = np.eye(3)
    mixed = rng.normal(0, 0.01, (12, 12))
    mixed[:3] = 0
    return PlanarPoses(("a", "b", "c", "d"), T, mixed @ mixed.T)


def calibration(poses: PlanarPoses) -> Calibration:
    """What finds these poses; each scanner hangs from the one before it."""
    T, spread = poses.in_space()
    own = spread.reshape(len(T), 6, len(T), 6)
    sensors = tuple(
        SensorPose(n, poses.names[k - 1] if k else None, n, "lidar2d", T[k], own[k, :, k], Verdict("good"))
        for k, n in enumerate(poses.names)
    )
    return Calibration("a", sensors, joint_covariance=spread)

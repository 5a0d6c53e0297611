"""The result of a drive that is small enough for hand-computed expectations.

The root drives along x at 1 m/s for 10 s, between walls at y = 3 and -3, from one at x = -5 to one at x = 20, on a
floor 1 m below. The start of the second scanner is off by 0.1 m to the left, and its clock by 20 ms.
"""

from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.result import (
    Calibration,
    DrivePath,
    DriveStart,
    DriveView,
    Pictures,
    SensorPose,
    Verdict,
    join_covariances,
)

DURATION = 10.0
TIMES = np.arange(0, DURATION + 0.01, 0.05)
REAR = se3.pose(so3.exp(np.array([0.0, 0.0, np.pi])), np.array([-0.5, 0.0, 0.0]))
SPREAD = np.diag([1e-3, 2e-3, 3e-3, 1e-3, 1e-3, 1e-3]) ** 2
OFF, LATE = 0.1, 0.02
"""Of the start, m and s."""
SURFACES = {
    "left": (60, np.array([0.0, 1, 0]), 3.0),
    "right": (60, np.array([0.0, -1, 0]), 3.0),
    "floor": (40, np.array([0.0, 0, -1]), 1.0),
}
"""Number of points, normal, and distance from the origin, m."""


def path_at(times: Array) -> Array:
    """``T_world_root`` (N, 4, 4)."""
    return se3.pose(np.tile(np.eye(3), (len(times), 1, 1)), times[:, None] * np.array([1.0, 0, 0]))


def view_of(sensor: str, T_root_sensor: Array, planar: bool, seed: int) -> DriveView:
    """Points of a scanner, exactly on surfaces but for residuals of 1 mm of either sign."""
    rng = np.random.default_rng(seed)
    surfaces = dict(SURFACES)
    if planar:
        surfaces.pop("floor")
    ahead = (40, np.array([1.0, 0, 0]), 20.0) if sensor == "front" else (40, np.array([-1.0, 0, 0]), 5.0)
    world, normals = [], []
    times = np.sort(rng.uniform(0.1, DURATION - 0.1, sum(one[0] for one in surfaces.values()) + 40))
    rng.shuffle(times)
    first = 0
    for count, normal, distance in (*surfaces.values(), ahead):
        at = times[first : first + count]
        first += count
        # To the sides and ahead of the scanner, and back to the surface.
        places = np.stack([at + rng.uniform(-1, 1, count), rng.uniform(-2, 2, count), 0 * at], axis=1)
        if not planar:
            places[:, 2] = rng.uniform(-0.5, 0.5, count)
        places += (distance - places @ normal)[:, None] * normal
        world.append(places)
        normals.append(np.tile(normal, (count, 1)))
    residuals = 0.001 * np.where(np.arange(len(times)) % 2, 1.0, -1.0)
    normal = np.concatenate(normals)
    T = se3.inverse(path_at(times) @ T_root_sensor)
    points = np.einsum("nij,nj->ni", T[:, :3, :3], np.concatenate(world)) + T[:, :3, 3]
    shared = np.ones(len(times), dtype=np.bool_)
    shared[-40:] = False
    return DriveView(sensor, 0, times, points.astype(np.float32), normal.astype(np.float32), residuals, shared)


def driven(*, planar: bool = False) -> Calibration:
    """The result; in the plane without the floor."""
    covariance = SPREAD.copy()
    if planar:
        covariance[2:5], covariance[:, 2:5] = np.nan, np.nan
    kind: Any = "lidar2d" if planar else "lidar3d"
    start = REAR.copy()
    start[1, 3] += OFF
    return Calibration(
        "front",
        (
            SensorPose("front", None, "front", kind, np.eye(4), Verdict("good")),
            SensorPose("rear", "front", "rear", kind, REAR, Verdict("weak", "why"), 0.05, 1e-4),
        ),
        join_covariances([np.zeros((6, 6)), covariance]),
        pictures=Pictures(
            drive_views=(view_of("front", np.eye(4), planar, 0), view_of("rear", REAR, planar, 1)),
            drive_paths=(DrivePath(TIMES, path_at(TIMES)),),
            drive_starts=(DriveStart("rear", start, 0.05 - LATE),),
        ),
    )


def driven_rig(*, planar: bool = False) -> Rig:
    """Its configuration."""
    kind = "lidar2d" if planar else "lidar3d"
    sensors = {name: {"kind": kind, "topic": f"/{name}"} for name in ("front", "rear")}
    return Rig.model_validate({"root": "front", "target": {"kind": "surroundings"}, "sensors": sensors})

"""The result of a network in space that is small enough for hand-computed expectations.

A hall of 10 m by 8 m and 5 m height, with its floor at z = 0. The root hangs in a corner, 3 m high and tilted; its
frame, levelled and shifted down to the floor, is that of the plan. A person walks along y = 4 m.
"""

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.result import (
    Calibration,
    CaptureRow,
    Edge,
    Evidence,
    FloorView,
    Pictures,
    SensorPose,
    Verdict,
    join_covariances,
)

T_PLAN_ROOT = se3.pose(so3.exp(np.array([0.3, 0.4, 0.0])), np.array([0.0, 0.0, 3.0]))
T_PLAN_OTHER = se3.pose(
    so3.exp(np.array([0.0, 0.0, 2.5])) @ so3.exp(np.array([np.pi - 0.2, 0.3, 0.0])), np.array([9.0, 7.0, 2.5])
)
"""Upside-down."""
STDDEV = np.array([0.01, 0.04, 0.02])
"""Of the position of the other sensor along the axes of the plan, m."""
BEFORE = se3.pose(so3.exp(np.array([0.0, 0.0, 0.2])), np.array([0.5, -0.3, 0.0]))
"""By which the other sensor was off before the joint solution, in the plan."""
WALK = np.linspace([2.0, 4.0], [8.0, 4.0], 61)
WALL = np.linspace([0.0, 8.0], [10.0, 8.0], 50)


def surfaces() -> Array:
    """(N, 3) points on the floor, a wall and the ceiling, 200 each, in the plan, m."""
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(0, 10, 20), np.linspace(0, 8, 10)))
    floor = np.column_stack([x, y, 0 * x])
    wall = np.column_stack([x, 0 * x + 8, y / 4])
    return np.concatenate([floor, wall, floor + np.array([0.0, 0.0, 5.0])])


def hall() -> Calibration:
    """The result."""
    T_root_plan = se3.inverse(T_PLAN_ROOT)
    T_root_other, R = T_root_plan @ T_PLAN_OTHER, T_root_plan[:3, :3]
    spread = np.zeros((6, 6))
    spread[:3, :3], spread[3:, 3:] = R @ np.diag(STDDEV**2) @ R.T, 1e-6 * np.eye(3)
    times = np.linspace(0.0, 6.0, 61)
    poses = {"root": T_PLAN_ROOT, "other": T_PLAN_OTHER}
    floor = tuple(
        FloorView(name, WALL, (WALK,), (times,), se3.apply(se3.inverse(T), surfaces()).astype(np.float32))
        for name, T in poses.items()
    )
    return Calibration(
        "root",
        (
            SensorPose("root", None, "root", "lidar3d", np.eye(4), Verdict("good")),
            SensorPose("other", "root", "other", "lidar3d", T_root_other, Verdict("good"), 0.01, 0.001),
        ),
        join_covariances([np.zeros((6, 6)), spread]),
        evidence=Evidence(
            estimator="joint",
            edges=(Edge("root", "other", 60, 50, True, np.array([0.01])),),
            captures=tuple(CaptureRow(k, 0.0, 6.0, name, True, "", 0.02) for k, name in enumerate(poses)),
            initial_poses={"root": np.eye(4), "other": T_root_plan @ BEFORE @ T_PLAN_OTHER},
        ),
        pictures=Pictures(floor_views=floor, T_plan_root=T_PLAN_ROOT),
    )


def hall_rig() -> Rig:
    """Its configuration."""
    sensors = {name: {"kind": "lidar3d", "topic": f"/{name}"} for name in ("root", "other")}
    return Rig.model_validate({"root": "root", "target": {"kind": "people"}, "sensors": sensors})

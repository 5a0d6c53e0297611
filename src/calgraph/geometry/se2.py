"""Poses in the plane as (..., 3, 3) homogeneous matrices; every function broadcasts over leading axes.

``T_a_b`` maps coordinates in b to coordinates in a. Tangent vectors are ``(x, y, theta)`` in metres and radians.
The group is that of :mod:`calgraph.geometry.se_n` with n = 2.
"""

import numpy as np

from calgraph.geometry.arrays import Array
from calgraph.geometry.se_n import (
    apply,
    compose_covariance,
    difference,
    inverse,
    inverse_covariance,
    relative_pose_jacobians,
    retract,
)

__all__ = [
    "angle", "apply", "compose_covariance", "difference", "inverse", "inverse_covariance", "pose",
    "relative_pose_jacobians", "retract", "to_se3",
]  # fmt: skip


def pose(theta: Array | float, t: Array) -> Array:
    """Poses (..., 3, 3) from angles (...,), rad, and translations (..., 2), m."""
    theta, t = np.asarray(theta, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(theta.shape, t.shape[:-1]), 3, 3))
    c, s = np.cos(theta), np.sin(theta)
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = c, -s, s, c
    T[..., :2, 2], T[..., 2, 2] = t, 1
    return T


def angle(T: Array) -> Array:
    """Angles (...,) of poses, rad, in [-π, π]."""
    return np.asarray(np.arctan2(T[..., 1, 0], T[..., 0, 0]))


def to_se3(T: Array) -> Array:
    """The same poses in space (..., 4, 4): in the plane z = 0, turned about z; those in space as they are."""
    if T.shape[-1] == 4:
        return T
    lifted = np.zeros((*T.shape[:-2], 4, 4))
    lifted[..., :2, :2], lifted[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    lifted[..., 2, 2] = lifted[..., 3, 3] = 1
    return lifted

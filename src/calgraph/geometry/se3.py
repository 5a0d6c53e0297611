"""Poses in space as (..., 4, 4) homogeneous matrices; every function broadcasts over leading axes.

``T_a_b`` maps coordinates in b to coordinates in a. Tangent vectors are (translation, rotation):
``(x, y, z, rx, ry, rz)`` in metres and radians. The group is that of :mod:`calgraph.geometry.se_n` with n = 3.
"""

import numpy as np

from calgraph.geometry import so3
from calgraph.geometry.arrays import Array
from calgraph.geometry.se_n import (
    apply,
    compose_covariance,
    difference,
    inverse,
    inverse_covariance,
    pose,
    relative_covariance,
    relative_pose_jacobians,
    retract,
)

__all__ = [
    "apply", "compose_covariance", "difference", "from_xyz_quaternion", "inverse", "inverse_covariance", "pose",
    "relative_covariance", "relative_pose_jacobians", "retract",
]  # fmt: skip


def from_xyz_quaternion(xyz: Array, xyzw: Array) -> Array:
    """Poses from translations (..., 3), m, and quaternions (..., 4) in the order x, y, z, w."""
    return pose(so3.from_quaternion(xyzw), np.asarray(xyz, dtype=np.float64))

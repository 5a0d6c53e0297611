"""Poses in space as (..., 4, 4) homogeneous matrices; every function broadcasts over leading axes.

``T_a_b`` maps coordinates in b to coordinates in a. Tangent vectors are (translation, rotation):
``(x, y, z, rx, ry, rz)`` in metres and radians.
"""

import numpy as np

from calgraph.geometry import so3
from calgraph.geometry.arrays import Array


def pose(R: Array, t: Array) -> Array:
    """Poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1
    return T


def inverse(T_a_b: Array) -> Array:
    """``T_b_a``, without a general matrix inverse."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return pose(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def apply(T_a_b: Array, x_b: Array) -> Array:
    """Points ``x_b`` (..., N, 3) in frame a: (..., N, 3)."""
    return np.asarray(x_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3])


def retract(T: Array, delta: Array) -> Array:
    """Moves poses by tangent vectors (..., 6) along the fixed axes of their parent frame.

    ``t + delta[:3]`` and ``exp(delta[3:]) @ R``: the perturbation in which calgraph publishes covariances, so
    that a solver's covariance needs no conversion.
    """
    return pose(so3.exp(delta[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + delta[..., :3])


def difference(T_est: Array, T: Array) -> Array:
    """The tangent vectors (..., 6) with ``retract(T, difference(T_est, T)) == T_est``: the error of T_est."""
    R = T_est[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2)
    return np.concatenate([T_est[..., :3, 3] - T[..., :3, 3], so3.log(R)], axis=-1)


def from_xyz_quaternion(xyz: Array, xyzw: Array) -> Array:
    """Poses from translations (..., 3), m, and quaternions (..., 4) in the order x, y, z, w."""
    return pose(so3.from_quaternion(xyzw), np.asarray(xyz, dtype=np.float64))


def compose_covariance(T_a_b: Array, cov_a_b: Array, cov_b_c: Array, t_b_c: Array) -> Array:
    """Covariance (6, 6) of ``T_a_c = T_a_b @ T_b_c`` for independent errors, each in its parent's fixed axes."""
    R = T_a_b[:3, :3]
    J_ab = np.eye(6)
    J_ab[:3, 3:] = -so3.hat(R @ t_b_c)
    J_bc = np.zeros((6, 6))
    J_bc[:3, :3] = J_bc[3:, 3:] = R
    return np.asarray(J_ab @ cov_a_b @ J_ab.T + J_bc @ cov_b_c @ J_bc.T)


def inverse_covariance(T_a_b: Array, cov_a_b: Array) -> Array:
    """Covariance (6, 6) of ``T_b_a`` in the fixed axes of b, from that of ``T_a_b`` in the fixed axes of a."""
    R_b_a = T_a_b[:3, :3].T
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = -R_b_a
    J[:3, 3:] = -R_b_a @ so3.hat(T_a_b[:3, 3])
    return np.asarray(J @ cov_a_b @ J.T)


def relative_pose_jacobians(T_r_a: Array, T_r_b: Array) -> tuple[Array, Array]:
    """Derivatives (..., 6, 6) of ``T_a_b`` in the fixed axes of a, by ``T_r_a`` and by ``T_r_b`` in those of r.

    To first order, errors (t, phi) of both poses at positions p, in the fixed axes of r, give the rotation error
    ``R_a_r @ (phi_b - phi_a)`` and the translation error ``R_a_r @ (t_b - t_a + (p_b - p_a) x phi_a)``.
    """
    R_a_r = np.swapaxes(T_r_a[..., :3, :3], -1, -2)
    by_a, by_b = np.zeros((2, *T_r_a.shape[:-2], 6, 6))
    by_b[..., :3, :3] = by_b[..., 3:, 3:] = R_a_r
    by_a[..., :3, :3] = by_a[..., 3:, 3:] = -R_a_r
    by_a[..., :3, 3:] = R_a_r @ so3.hat(T_r_b[..., :3, 3] - T_r_a[..., :3, 3])
    return by_a, by_b


def relative_covariance(T_r_a: Array, T_r_b: Array, joint: Array) -> Array:
    """Covariance (6, 6) of ``T_a_b`` in the fixed axes of a, from the joint one (12, 12) of T_r_a and T_r_b."""
    J = np.concatenate(relative_pose_jacobians(T_r_a, T_r_b), axis=-1)
    return np.asarray(J @ joint @ J.T)

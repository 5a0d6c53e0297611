"""Poses in the plane as (..., 3, 3) homogeneous matrices; every function broadcasts over leading axes.

The same functions as :mod:`calgraph.geometry.se3`. ``T_a_b`` maps coordinates in b to coordinates in a. Tangent
vectors are ``(x, y, theta)`` in metres and radians.
"""

import numpy as np

from calgraph.geometry.arrays import Array


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


def inverse(T_a_b: Array) -> Array:
    """``T_b_a``, without a general matrix inverse."""
    R_b_a = np.swapaxes(T_a_b[..., :2, :2], -1, -2)
    return pose(-angle(T_a_b), -(R_b_a @ T_a_b[..., :2, 2:])[..., 0])


def apply(T_a_b: Array, x_b: Array) -> Array:
    """Points ``x_b`` (..., N, 2) in frame a: (..., N, 2)."""
    return np.asarray(x_b @ np.swapaxes(T_a_b[..., :2, :2], -1, -2) + T_a_b[..., None, :2, 2])


def retract(T: Array, delta: Array) -> Array:
    """Moves poses by tangent vectors (..., 3) along the fixed axes of their parent frame.

    ``t + delta[:2]`` and ``theta + delta[2]``: the perturbation in which calgraph publishes covariances.
    """
    return pose(angle(T) + delta[..., 2], T[..., :2, 2] + delta[..., :2])


def difference(T_est: Array, T: Array) -> Array:
    """The tangent vectors (..., 3) with ``retract(T, difference(T_est, T)) == T_est``: the error of T_est."""
    turned = np.swapaxes(T[..., :2, :2], -1, -2) @ T_est[..., :2, :2]
    return np.concatenate([T_est[..., :2, 2] - T[..., :2, 2], angle(turned)[..., None]], axis=-1)


def compose_covariance(T_a_b: Array, cov_a_b: Array, cov_b_c: Array, t_b_c: Array) -> Array:
    """Covariance (3, 3) of ``T_a_c = T_a_b @ T_b_c`` for independent errors, each in its parent's fixed axes."""
    x, y = T_a_b[:2, :2] @ t_b_c
    J_ab, J_bc = np.eye(3), np.eye(3)
    J_ab[:2, 2] = -y, x
    J_bc[:2, :2] = T_a_b[:2, :2]
    return np.asarray(J_ab @ cov_a_b @ J_ab.T + J_bc @ cov_b_c @ J_bc.T)


def inverse_covariance(T_a_b: Array, cov_a_b: Array) -> Array:
    """Covariance (3, 3) of ``T_b_a`` in the fixed axes of b, from that of ``T_a_b`` in the fixed axes of a."""
    R_b_a = T_a_b[:2, :2].T
    x, y = T_a_b[:2, 2]
    J = -np.eye(3)
    J[:2, :2] = -R_b_a
    J[:2, 2] = R_b_a @ np.array([-y, x])
    return np.asarray(J @ cov_a_b @ J.T)


def to_se3(T: Array) -> Array:
    """The same poses in space (..., 4, 4): in the plane z = 0, turned about z."""
    lifted = np.zeros((*T.shape[:-2], 4, 4))
    lifted[..., :2, :2], lifted[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    lifted[..., 2, 2] = lifted[..., 3, 3] = 1
    return lifted

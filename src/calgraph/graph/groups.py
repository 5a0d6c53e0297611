"""SO(n) and SE(n) for n = 2 and 3 alike: the dimension is read off the arrays' shapes.

Rotation vectors have d = 1 or 3 components, tangent vectors n + d, translation first. Every function broadcasts
over leading axes.
"""

import numpy as np

from calgraph.geometry import Array, se2, so3


def exp(phi: Array) -> Array:
    """Rotations (..., n, n) of rotation vectors (..., d), rad."""
    if phi.shape[-1] == 3:
        return so3.exp(phi)
    return se2.pose(phi[..., 0], np.zeros(2))[..., :2, :2]


def log(R: Array) -> Array:
    """Rotation vectors (..., d) of rotations (..., n, n), with angles in [-π, π]."""
    return so3.log(R) if R.shape[-1] == 3 else se2.angle(R)[..., None]


def magnitude(R: Array) -> Array:
    """Angles (...,) of rotations (..., n, n), rad, in [0, π]."""
    return np.asarray(np.linalg.norm(log(R), axis=-1))


def nearest(M: Array) -> Array:
    """The rotations nearest to matrices (..., n, n) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    flip = np.ones(M.shape[:-1])
    flip[..., -1] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)


def transpose(R: Array) -> Array:
    """Inverse rotations."""
    return np.swapaxes(R, -1, -2)


def rotation(T: Array) -> Array:
    """The rotations (..., n, n) of poses."""
    return T[..., :-1, :-1]


def translation(T: Array) -> Array:
    """The translations (..., n) of poses, m."""
    return T[..., :-1, -1]


def pose(R: Array, t: Array) -> Array:
    """Poses (..., n+1, n+1) from rotations (..., n, n) and translations (..., n)."""
    n = t.shape[-1]
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), n + 1, n + 1))
    T[..., :n, :n], T[..., :n, n], T[..., n, n] = R, t, 1
    return T


def inverse(T_a_b: Array) -> Array:
    """``T_b_a``."""
    R_b_a = transpose(rotation(T_a_b))
    return pose(R_b_a, -(R_b_a @ translation(T_a_b)[..., None])[..., 0])


def retract(T: Array, delta: Array) -> Array:
    """Moves poses by tangent vectors (..., n+d) along the fixed axes of their parent frame."""
    n = T.shape[-1] - 1
    return pose(exp(delta[..., n:]) @ rotation(T), translation(T) + delta[..., :n])


def difference(T_est: Array, T: Array) -> Array:
    """The tangent vectors (..., n+d) with ``retract(T, difference(T_est, T)) == T_est``: the error of T_est."""
    turned = rotation(T_est) @ transpose(rotation(T))
    return np.concatenate([translation(T_est) - translation(T), log(turned)], axis=-1)


def turning(x: Array) -> Array:
    """``J`` (..., n, d) with ``exp(phi) @ x ≈ x + J @ phi`` for small ``phi``; ``x`` is (..., n)."""
    if x.shape[-1] == 3:
        return -so3.hat(x)
    return np.stack([-x[..., 1], x[..., 0]], axis=-1)[..., None]


def axes(R: Array) -> Array:
    """(..., n+d, n+d) that turns tangent vectors from one frame's fixed axes into another's."""
    n = R.shape[-1]
    d = 1 if n == 2 else 3
    B = np.zeros((*R.shape[:-2], n + d, n + d))
    B[..., :n, :n] = R
    B[..., n:, n:] = R if n == 3 else 1.0
    return B


def compose_covariance(T_a_b: Array, cov_a_b: Array, cov_b_c: Array, t_b_c: Array) -> Array:
    """Covariance (..., n+d, n+d) of ``T_a_b @ T_b_c`` for independent errors, each in its parent's fixed axes."""
    n = t_b_c.shape[-1]
    J_ab = np.zeros_like(cov_a_b) + np.eye(cov_a_b.shape[-1])
    J_ab[..., :n, n:] = turning((rotation(T_a_b) @ t_b_c[..., None])[..., 0])
    J_bc = axes(rotation(T_a_b))
    return np.asarray(J_ab @ cov_a_b @ transpose(J_ab) + J_bc @ cov_b_c @ transpose(J_bc))


def inverse_covariance(T_a_b: Array, cov_a_b: Array) -> Array:
    """Covariance (..., n+d, n+d) of ``T_b_a`` in the fixed axes of b, from that of ``T_a_b`` in those of a."""
    n = T_a_b.shape[-1] - 1
    J = np.zeros_like(cov_a_b) + np.eye(cov_a_b.shape[-1])
    J[..., :n, n:] = -turning(translation(T_a_b))
    J = -axes(transpose(rotation(T_a_b))) @ J
    return np.asarray(J @ cov_a_b @ transpose(J))

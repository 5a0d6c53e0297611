"""SO(n) and SE(n) for n = 2 and n = 3: the dimension follows from the shapes of the arrays.

Rotation vectors have d = 1 or 3 components, tangent vectors n + d, translation first. Every function broadcasts
over leading axes. ``T_a_b`` maps coordinates in b to coordinates in a. Perturbations and errors are along the
fixed axes of the parent frame a, ``t + delta[:n]`` and ``exp(delta[n:]) @ R``. Covariances are published in
this perturbation, so that the covariance of a solver needs no conversion.
"""

import numpy as np

from calgraph.geometry import so3
from calgraph.geometry.arrays import Array


def exp(phi: Array) -> Array:
    """Rotations (..., n, n) of rotation vectors (..., d), rad."""
    if phi.shape[-1] == 3:
        return so3.exp(phi)
    c, s = np.cos(phi[..., 0]), np.sin(phi[..., 0])
    R = np.empty((*phi.shape[:-1], 2, 2))
    R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    return R


def log(R: Array) -> Array:
    """Rotation vectors (..., d) of rotations (..., n, n), with angles in [-π, π], rad."""
    return so3.log(R) if R.shape[-1] == 3 else np.arctan2(R[..., 1, 0], R[..., 0, 0])[..., None]


def rotation_angle(R: Array) -> Array:
    """Angles (...,) of rotations (..., n, n), rad, in [0, π]."""
    return np.asarray(np.linalg.norm(log(R), axis=-1))


def nearest_rotation(M: Array) -> Array:
    """The rotations nearest to matrices (..., n, n) in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(M)
    flip = np.ones(M.shape[:-1])
    flip[..., -1] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)


def transpose(M: Array) -> Array:
    """Transposed matrices; of rotations, the inverse ones."""
    return np.swapaxes(M, -1, -2)


def rotation(T: Array) -> Array:
    """The rotations (..., n, n) of poses (..., n+1, n+1)."""
    return T[..., :-1, :-1]


def translation(T: Array) -> Array:
    """The translations (..., n) of poses (..., n+1, n+1), m."""
    return T[..., :-1, -1]


def pose(R: Array, t: Array) -> Array:
    """Poses (..., n+1, n+1) from rotations (..., n, n) and translations (..., n)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    n = t.shape[-1]
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), n + 1, n + 1))
    T[..., :n, :n], T[..., :n, n], T[..., n, n] = R, t, 1
    return T


def inverse(T_a_b: Array) -> Array:
    """``T_b_a``, without a general matrix inverse."""
    R_b_a = transpose(rotation(T_a_b))
    return pose(R_b_a, -(R_b_a @ translation(T_a_b)[..., None])[..., 0])


def apply(T_a_b: Array, x_b: Array) -> Array:
    """Points ``x_b`` (..., N, n) in frame a: (..., N, n)."""
    return np.asarray(x_b @ transpose(rotation(T_a_b)) + translation(T_a_b)[..., None, :])


def retract(T: Array, delta: Array) -> Array:
    """Moves poses (..., n+1, n+1) by tangent vectors (..., n+d) along the fixed axes of their parent frame."""
    n = T.shape[-1] - 1
    return pose(exp(delta[..., n:]) @ rotation(T), translation(T) + delta[..., :n])


def difference(T_est: Array, T: Array) -> Array:
    """The tangent vectors (..., n+d) with ``retract(T, difference(T_est, T)) == T_est``: the error of T_est."""
    R_error = rotation(T_est) @ transpose(rotation(T))
    return np.concatenate([translation(T_est) - translation(T), log(R_error)], axis=-1)


def rotation_jacobian(x: Array) -> Array:
    """``J`` (..., n, d) with ``exp(phi) @ x ≈ x + J @ phi`` for small ``phi``; ``x`` is (..., n)."""
    if x.shape[-1] == 3:
        return -so3.hat(x)
    return np.stack([-x[..., 1], x[..., 0]], axis=-1)[..., None]


def rotation_adjoint(R: Array) -> Array:
    """(..., n+d, n+d) that maps tangent vectors from the fixed axes of one frame to those of a rotated frame."""
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
    J_ab[..., :n, n:] = rotation_jacobian((rotation(T_a_b) @ t_b_c[..., None])[..., 0])
    J_bc = rotation_adjoint(rotation(T_a_b))
    return np.asarray(J_ab @ cov_a_b @ transpose(J_ab) + J_bc @ cov_b_c @ transpose(J_bc))


def inverse_covariance(T_a_b: Array, cov_a_b: Array) -> Array:
    """Covariance (..., n+d, n+d) of ``T_b_a`` in the fixed axes of b, from that of ``T_a_b`` in those of a."""
    n = T_a_b.shape[-1] - 1
    J = -rotation_adjoint(transpose(rotation(T_a_b)))
    J[..., :n, n:] = J[..., :n, :n] @ -rotation_jacobian(translation(T_a_b))
    return np.asarray(J @ cov_a_b @ transpose(J))


def relative_pose_jacobians(T_r_a: Array, T_r_b: Array) -> tuple[Array, Array]:
    """Derivatives (..., n+d, n+d) of ``T_a_b`` in the fixed axes of a, by ``T_r_a`` and ``T_r_b`` in those of r.

    To first order, errors (t, phi) of both poses at positions p, in the fixed axes of r, give the rotation error
    ``R_a_r @ (phi_b - phi_a)`` and the translation error ``R_a_r @ (t_b - t_a - phi_a x (p_b - p_a))``.
    """
    n = T_r_a.shape[-1] - 1
    by_b = rotation_adjoint(transpose(rotation(T_r_a)))
    by_a = -by_b
    by_a[..., :n, n:] = by_b[..., :n, :n] @ -rotation_jacobian(translation(T_r_b) - translation(T_r_a))
    return by_a, by_b


def relative_covariance(T_r_a: Array, T_r_b: Array, joint: Array) -> Array:
    """Covariance of ``T_a_b`` in the fixed axes of a, from the joint one (2(n+d), 2(n+d)) of T_r_a and T_r_b."""
    J = np.concatenate(relative_pose_jacobians(T_r_a, T_r_b), axis=-1)
    return np.asarray(J @ joint @ transpose(J))

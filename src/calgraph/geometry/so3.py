"""Rotations in space as (..., 3, 3) matrices; every function broadcasts over leading axes.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix B.
"""

import numpy as np

from calgraph.geometry.arrays import Array

# Below this angle (rad) the closed forms lose digits and their Taylor series are exact to rounding.
_SMALL = 1e-4


def hat(v: Array) -> Array:
    """Skew matrices with ``hat(v) @ x == cross(v, x)``; ``v`` is (..., 3), the result (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _series(angle: Array, closed: Array, taylor: Array | float) -> Array:
    return np.where(angle < _SMALL, taylor, closed)


def exp(phi: Array) -> Array:
    """Rotation matrices of rotation vectors ``phi`` (..., 3), rad (Rodrigues' formula)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.maximum(angle, _SMALL)
    a = _series(angle, np.sin(safe) / safe, 1 - angle**2 / 6)[..., None, None]
    b = _series(angle, (1 - np.cos(safe)) / safe**2, 0.5)[..., None, None]
    K = hat(phi)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def log(R: Array) -> Array:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3), with angles in [0, π].

    Goes through the unit quaternion, which stays well-conditioned at the angle π where the matrix logarithm
    does not.
    """
    q = quaternion(R)
    xyz, w = q[..., :3], q[..., 3]
    sine = np.linalg.norm(xyz, axis=-1)
    angle = 2 * np.arctan2(sine, w)
    scale = np.where(sine < _SMALL, 2 + sine**2 / 3, angle / np.maximum(sine, _SMALL))
    return np.asarray(scale[..., None] * xyz)


def quaternion(R: Array) -> Array:
    """Unit quaternions (..., 4) in the order x, y, z, w, with w >= 0 (Bar-Itzhack's eigenvalue-free form)."""
    R = np.asarray(R, dtype=np.float64)
    d = np.diagonal(R, axis1=-2, axis2=-1)
    trace = d.sum(-1)
    candidates = np.empty((*R.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        candidates[..., i, i] = 1 + 2 * d[..., i] - trace
        candidates[..., i, j] = R[..., i, j] + R[..., j, i]
        candidates[..., i, k] = R[..., i, k] + R[..., k, i]
        candidates[..., i, 3] = R[..., k, j] - R[..., j, k]
        candidates[..., 3, i] = candidates[..., i, 3]
    candidates[..., 3, 3] = 1 + trace
    # Each row is the quaternion times one of its own components; the largest component is the safe divisor.
    best = np.argmax(np.concatenate([d, trace[..., None]], axis=-1), axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def from_quaternion(q: Array) -> Array:
    """Rotation matrices of quaternions (..., 4) in the order x, y, z, w; they are normalised first."""
    q = np.asarray(q, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    K = hat(q[..., :3])
    return np.asarray(np.eye(3) + 2 * q[..., 3, None, None] * K + 2 * (K @ K))


def left_jacobian(phi: Array) -> Array:
    """``J`` with ``exp(phi + d) ≈ exp(J @ d) @ exp(phi)`` for small ``d`` (Solà et al., eq. 145)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.maximum(angle, _SMALL)
    # (1 - cos θ)/θ² by the half angle, which keeps all digits of small ones.
    b = _series(angle, 2 * (np.sin(safe / 2) / safe) ** 2, 0.5)[..., None, None]
    c = _series(angle, (safe - np.sin(safe)) / safe**3, 1 / 6)[..., None, None]
    K = hat(phi)
    return np.asarray(np.eye(3) + b * K + c * (K @ K))


def left_jacobian_inverse(phi: Array) -> Array:
    """``J`` with ``log(exp(d) @ exp(phi)) ≈ phi + J @ d`` for small ``d`` (Solà et al., eq. 146)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.maximum(angle, _SMALL)
    half = safe / 2
    # θ/2 · cot(θ/2) stays finite up to θ = 2π, unlike the textbook form with sin θ in the denominator.
    c = _series(angle, (1 - half / np.tan(half)) / safe**2, 1 / 12)[..., None, None]
    K = hat(phi)
    return np.asarray(np.eye(3) - 0.5 * K + c * (K @ K))


def rotate(phi: Array, vectors: Array) -> Array:
    """Vectors (N, 3) rotated by rotation vectors ``phi`` (N, 3), rad (Rodrigues' formula), column-major."""
    *horizontal, angle = phi.T
    if not np.any(horizontal):
        # About the z axis, as beams in one plane: in a third of the time.
        c, s, (x, y, z) = np.cos(angle), np.sin(angle), vectors.T
        return np.stack([c * x - s * y, s * x + c * y, z]).T
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.maximum(angle, _SMALL)
    a = _series(angle, np.sin(safe) / safe, 1 - angle**2 / 6)
    b = _series(angle, (1 - np.cos(safe)) / safe**2, 0.5)
    across = cross(phi, vectors)
    return np.asarray(vectors + a[:, None] * across + b[:, None] * cross(phi, across))


def cross(a: Array, b: Array) -> Array:
    """Cross products (N, 3) of vectors (N, 3), column-major; in a third of NumPy's time."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Angles about the fixed axes x, y, z, rad, with ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)`` also at pitch ±90°.

    There roll and yaw rotate about the same axis: pitch and roll are computed after the yaw is removed.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    rest = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
    return float(np.arctan2(-rest[1, 2], rest[1, 1])), float(np.arctan2(-rest[2, 0], rest[0, 0])), float(yaw)


def from_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation matrix of angles about the fixed axes x, y, z, rad: ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
    Rz, Ry, Rx = (exp(angle * axis) for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True))
    return np.asarray(Rz @ Ry @ Rx)

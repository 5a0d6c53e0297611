"""Planes ``n @ x + d = 0`` as (..., 4) rows ``(nx, ny, nz, d)`` with unit normals.

Observed planes are oriented so that ``d >= 0``: the normal points at the sensor in the origin.
"""

import numpy as np

from calgraph.geometry.arrays import Array


def towards_origin(planes: Array) -> Array:
    """The same planes with the sign that makes ``d >= 0``."""
    return np.asarray(np.where(planes[..., 3:] < 0, -planes, planes))


def from_pose(T_a_board: Array) -> Array:
    """The plane z = 0 of boards with poses (..., 4, 4), with the board's z axis as normal, in frame a."""
    n, t = T_a_board[..., :3, 2], T_a_board[..., :3, 3]
    return np.concatenate([n, -np.sum(n * t, axis=-1, keepdims=True)], axis=-1)


def transform(T_a_b: Array, planes_b: Array) -> Array:
    """Planes (..., 4) given in frame b, in frame a (normals rotated, not reoriented)."""
    n = (T_a_b[..., :3, :3] @ planes_b[..., :3, None])[..., 0]
    return np.concatenate([n, planes_b[..., 3:] - np.sum(n * T_a_b[..., :3, 3], axis=-1, keepdims=True)], axis=-1)


def distance(planes: Array, points: Array) -> Array:
    """Signed distances (..., N) of points (..., N, 3) from planes (..., 4), positive on the normal's side."""
    return np.asarray((points @ planes[..., :3, None])[..., 0] + planes[..., 3:])


def distance_jacobian(planes: Array, points: Array) -> Array:
    """Derivatives (..., N, 3) of the distances of points (..., N, 3) by the chart of :func:`retract`."""
    along = points @ tangent_basis(planes[..., :3])
    return np.concatenate([along, np.ones((*along.shape[:-1], 1))], axis=-1)


def fit(points: Array, weights: Array | None = None) -> Array:
    """The total-least-squares plane (4,) of points (N, 3), N >= 3, oriented towards the origin.

    Args:
        points: (N, 3), m.
        weights: (N,), inverse variances along the normal; equal if left out.
    """
    centre = points.mean(axis=0) if weights is None else np.average(points, axis=0, weights=weights)
    centred = points - centre
    weighted = centred if weights is None else centred * weights[:, None]
    _, vectors = np.linalg.eigh(weighted.T @ centred)
    n = vectors[:, 0]
    return towards_origin(np.append(n, -n @ centre))


def tangent_basis(normals: Array) -> Array:
    """Two unit vectors orthogonal to each normal: (..., 3) to (..., 3, 2), right-handed with the normal.

    Branch-free construction of Duff et al., "Building an orthonormal basis, revisited", JCGT 2017.
    """
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    basis = np.empty((*normals.shape, 2))
    basis[..., 0, 0], basis[..., 1, 0], basis[..., 2, 0] = 1 + sign * x * x * a, sign * b, -sign * x
    basis[..., 0, 1], basis[..., 1, 1], basis[..., 2, 1] = b, sign + y * y * a, -y
    return basis


def retract(planes: Array, delta: Array) -> Array:
    """Moves planes (..., 4) by (..., 3): two small rotations of the normal in its tangent basis, then d (m)."""
    step = (tangent_basis(planes[..., :3]) @ delta[..., :2, None])[..., 0]
    n = planes[..., :3] + step
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)
    return np.concatenate([n, planes[..., 3:] + delta[..., 2:]], axis=-1)

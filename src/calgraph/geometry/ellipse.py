"""Ellipses as (..., 5) rows ``(x, y, angle, a, b)``: centre, m, direction of the first axis, rad, and radii, m.

Every function broadcasts over leading axes; points come in groups (..., N, 2) with a mask (..., N) of those used.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry.arrays import Array


def points(ellipses: Array, phases: Array) -> Array:
    """Points (..., N, 2) of ellipses (..., 5) at the parameters ``phases`` (..., N), rad (lrf-network, eq. 4)."""
    along = ellipses[..., None, 3] * np.cos(phases)
    across = ellipses[..., None, 4] * np.sin(phases)
    c, s = np.cos(ellipses[..., None, 2]), np.sin(ellipses[..., None, 2])
    return np.stack([c * along - s * across, s * along + c * across], axis=-1) + ellipses[..., None, :2]


def fit_direct(points: Array, used: NDArray[np.bool_]) -> Array:
    """The ellipses (..., 5) with the least algebraic distance from points; NaN where there is none.

    The constraint 4ac - b² = 1 makes every solution an ellipse. Points are shifted and scaled first, and the
    linear part is eliminated, which keeps the eigenvalue problem regular.

    Args:
        points: (..., N, 2); at least six used ones in a group are needed.
        used: (..., N).

    Source: Fitzgibbon, Pilu, Fisher, "Direct least squares fitting of ellipses", 1999, in the form of Halir and
    Flusser, "Numerically stable direct least squares fitting of ellipses", 1998.
    """
    enough = used.sum(axis=-1) >= 6
    weight = used[..., None].astype(float)
    count = np.maximum(weight.sum(axis=-2), 1)
    centre = (weight * np.where(used[..., None], points, 0.0)).sum(axis=-2) / count
    off = np.where(used[..., None], points - centre[..., None, :], 0.0)
    scale = np.sqrt((off**2).sum(axis=(-2, -1)) / count[..., 0])
    scale = np.where(scale > 0, scale, 1.0)
    x, y = np.moveaxis(off / scale[..., None, None], -1, 0)
    quadratic = np.stack([x * x, x * y, y * y], axis=-1)
    linear = np.stack([x, y, used.astype(float)], axis=-1)
    S1 = np.swapaxes(quadratic, -1, -2) @ quadratic
    S2 = np.swapaxes(quadratic, -1, -2) @ linear
    S3 = np.swapaxes(linear, -1, -2) @ linear
    # On a line S3 is singular, and no ellipse is determined.
    regular = enough & (np.linalg.cond(np.where(enough[..., None, None], S3, np.eye(3))) < 1e10)
    T = -np.linalg.solve(np.where(regular[..., None, None], S3, np.eye(3)), np.swapaxes(S2, -1, -2))
    M = S1 + S2 @ T
    M = np.stack([M[..., 2, :] / 2, -M[..., 1, :], M[..., 0, :] / 2], axis=-2)
    vectors = np.linalg.eig(M)[1].real
    positive = 4 * vectors[..., 0, :] * vectors[..., 2, :] - vectors[..., 1, :] ** 2
    best = np.take_along_axis(vectors, np.argmax(positive, axis=-1)[..., None, None], axis=-1)
    conic = np.concatenate([best, T @ best], axis=-2)[..., 0]
    shape = _of_conic(conic)
    valid = regular & (positive.max(axis=-1) > 0) & np.isfinite(shape).all(axis=-1)
    shape[..., [0, 1, 3, 4]] *= scale[..., None]
    shape[..., :2] += centre
    return np.where(valid[..., None], shape, np.nan)


def _of_conic(conic: Array) -> Array:
    """Ellipses of ``A x² + B xy + C y² + D x + E y + F = 0`` (..., 6), with a >= b; NaN where it is none."""
    A, B, C, D, E, F = np.moveaxis(conic, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = 4 * A * C - B * B
        x, y = (B * E - 2 * C * D) / determinant, (B * D - 2 * A * E) / determinant
        value = F + (D * x + E * y) / 2
        mean, half = (A + C) / 2, np.hypot((A - C) / 2, B / 2)
        # Along a direction the radius is sqrt(-value / eigenvalue); the smaller eigenvalue is the longer axis's.
        sign = np.where(mean < 0, -1.0, 1.0)
        a, b = np.sqrt(-value * sign / (np.abs(mean) - half)), np.sqrt(-value * sign / (np.abs(mean) + half))
        angle = 0.5 * np.arctan2(-sign * B, -sign * (A - C))
    return np.stack([x, y, angle, a, b], axis=-1)

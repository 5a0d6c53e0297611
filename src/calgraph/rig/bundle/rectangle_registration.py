"""Registers rectangles to points on their outlines, in the plane."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se3, so3

# Grids of the search over rotations: coarse, then about its minimum, rad. Its result, to half a degree, is a start
# value of the bundle; half a coarse step moves the edges of a board of 1 m by 2 cm, less than the distance at
# which the search truncates.
_COARSE_ANGLES = np.radians(np.arange(0.0, 180.0, 5.0))
_FINE_ANGLES = np.radians(np.arange(-4.0, 4.5, 1.0))
# Iterations of the translation on either grid: each side's mean converges in two, once its edges are assigned.
_COARSE_ITERATIONS, _FINE_ITERATIONS = 2, 6


# Minimum number of edges of a board: its pose in the plane has three parameters.
_MIN_POINTS = 6
# Distances of edges from the outline are truncated at this: three standard deviations of the coarsest.
_MAX_DISTANCE = 0.05
# Minimum difference of other rotations, rad (20°): smaller ones belong to the same minimum.
_MIN_ROTATION_APART = math.radians(20)
# Maximum mean distance of edges from an accepted outline: edges between beams 5 cm apart have 12 mm.
_MAX_MEAN_DISTANCE = 0.02
# Minimum ratio of the mean distances of any other rotation and the best one: outlines of nearly square boards are
# ambiguous.
_AMBIGUITY_RATIO = 1.5


def register_rectangles(points: Sequence[Array], half: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Poses of rectangles in the plane from points on their outlines.

    Args:
        points: (M, 2) of each of n rectangles, in its plane, m.
        half: (2,) half width and half height of all of them, m.

    Returns:
        (n, 4, 4) poses of the rectangles in their planes, and (n,) whether each is certain: it has enough points,
        and one rotation only fits.
    """
    T = np.tile(np.eye(4), (len(points), 1, 1))
    enough = np.array([len(p) >= _MIN_POINTS for p in points], dtype=np.bool_)
    if not enough.any():
        return T, enough
    padded, valid = _pad_points([p for p, several in zip(points, enough, strict=True) if several])
    n = np.arange(len(padded))
    angles = np.broadcast_to(_COARSE_ANGLES, (len(padded), len(_COARSE_ANGLES)))
    _, distances = _register_shifts(padded, valid, angles, half, _MAX_DISTANCE, _COARSE_ITERATIONS)
    best = np.argmin(distances, axis=1)
    apart = np.abs((_COARSE_ANGLES - _COARSE_ANGLES[best, None] + np.pi / 2) % np.pi - np.pi / 2)
    second = np.where(apart > _MIN_ROTATION_APART, distances, np.inf).min(axis=1)
    unique = (distances[n, best] <= _MAX_MEAN_DISTANCE) & (second >= _AMBIGUITY_RATIO * distances[n, best])
    angles = _COARSE_ANGLES[best, None] + _FINE_ANGLES
    centers, distances = _register_shifts(padded, valid, angles, half, _MAX_DISTANCE, _FINE_ITERATIONS)
    best = np.argmin(distances, axis=1)
    R = so3.exp(np.column_stack([np.zeros((len(padded), 2)), angles[n, best]]))
    shifts = np.column_stack([centers[n, best], np.zeros(len(padded))])
    T[enough] = se3.pose(R, (R @ shifts[..., None])[..., 0])
    certain = enough.copy()
    certain[enough] = unique
    return T, certain


def _pad_points(points: Sequence[Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Points (n, M, 2) of all rectangles, padded by their first point, and which of them are valid (n, M)."""
    most = max(map(len, points))
    padded = np.stack([np.concatenate([p, np.tile(p[0], (most - len(p), 1))]) for p in points])
    return padded, np.arange(most) < np.array([[len(p)] for p in points])


def _register_shifts(
    points: Array, valid: NDArray[np.bool_], angles: Array, half: Array, max_distance: float, rounds: int
) -> tuple[Array, Array]:
    """Translations that minimise the distances of outlines rotated by (n, A) from points (n, M, 2), (n, M) valid.

    Returns:
        Centres (n, A, 2) along the rotated axes, and mean distances (n, A) of the points from the outlines, m.
    """
    c, s = np.cos(angles)[..., None], np.sin(angles)[..., None]
    x, y = points[:, None, :, 0], points[:, None, :, 1]
    rotated = np.stack([c * x + s * y, c * y - s * x], axis=-1)
    valid = valid[:, None]
    centers = (rotated.min(axis=2) + rotated.max(axis=2)) / 2
    for _ in range(rounds):
        off, nearest = _offsets_from_sides(rotated - centers[:, :, None], half)
        shifts = [_limited_mean(off[..., axis], valid & (nearest == axis), max_distance) for axis in (0, 1)]
        centers = centers + np.stack(shifts, axis=-1)
    off, nearest = _offsets_from_sides(rotated - centers[:, :, None], half)
    distance = np.abs(np.where(nearest == 0, off[..., 0], off[..., 1]))
    return centers, _limited_mean(distance, np.broadcast_to(valid, distance.shape), max_distance)


def _offsets_from_sides(points: Array, half: Array) -> tuple[Array, Index]:
    """Offsets (..., 2) of points from the nearer of two parallel sides, and the axis across the nearest side."""
    off = points - np.copysign(half, points)
    beside = np.maximum(np.abs(points) - half, 0)
    # Squared distances from both pairs of sides.
    far_x = off[..., 0] ** 2 + beside[..., 1] ** 2
    far_y = off[..., 1] ** 2 + beside[..., 0] ** 2
    return off, np.asarray(far_y < far_x, dtype=np.intp)


def _limited_mean(values: Array, valid: NDArray[np.bool_], limit: float) -> Array:
    """Means over the last axis of the valid values, truncated; 0 where there are none."""
    limited = np.clip(values, -limit, limit)
    return np.asarray(np.sum(limited * valid, axis=-1) / np.maximum(valid.sum(axis=-1), 1))

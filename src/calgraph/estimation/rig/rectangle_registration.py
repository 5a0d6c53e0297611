"""Lays sheets in their planes so that they end where they were seen to end."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se3, so3

# So many points are needed to lay a sheet.
_MIN_POINTS = 6
_COARSE_ANGLES = np.radians(np.arange(0.0, 180.0, 5.0))
_FINE_ANGLES = np.radians(np.arange(-4.0, 4.5, 1.0))
# A rectangle is shifted so many times to where it fits better: while its turn is sought, and then.
_COARSE_ITERATIONS, _FINE_ITERATIONS = 2, 6
# Of a point the distance from the outline counts up to this, m.
_MAX_DISTANCE = 0.05
# A sheet is laid right if points are on average as near to its sides as this, m; turned otherwise, so much worse.
_MAX_MEAN_DISTANCE, _AMBIGUITY_RATIO = 0.02, 1.5
# What is turned by less is not turned otherwise, rad.
_MIN_ANGLE_APART = np.radians(20.0)


def register_rectangles(points: Sequence[Array], half: Array) -> tuple[Array, NDArray[np.bool_]]:
    """How sheets lie, told by points on their outlines alone.

    Args:
        points: (M, 2) of each of n sheets, in its plane, m.
        half: (2,) half the width and half the height of all of them, m.

    Returns:
        (n, 4, 4) poses of the sheets in their planes, and (n,) which of them are certain: enough of the outline
        was seen, and it fits one way only.
    """
    found = np.tile(np.eye(4), (len(points), 1, 1))
    told = np.array([len(own) >= _MIN_POINTS for own in points], dtype=np.bool_)
    if not told.any():
        return found, told
    own, counted = _pad_points([p for p, enough in zip(points, told, strict=True) if enough])
    each = np.arange(len(own))
    _, misses = _register_shifts(
        own, counted, np.broadcast_to(_COARSE_ANGLES, (len(own), len(_COARSE_ANGLES))), half, _COARSE_ITERATIONS
    )
    best = np.argmin(misses, axis=1)
    apart = np.abs((_COARSE_ANGLES - _COARSE_ANGLES[best, None] + np.pi / 2) % np.pi - np.pi / 2)
    rival = np.where(apart > _MIN_ANGLE_APART, misses, np.inf).min(axis=1)
    certain = (misses[each, best] <= _MAX_MEAN_DISTANCE) & (rival >= _AMBIGUITY_RATIO * misses[each, best])
    turns = _COARSE_ANGLES[best, None] + _FINE_ANGLES
    centers, misses = _register_shifts(own, counted, turns, half, _FINE_ITERATIONS)
    best = np.argmin(misses, axis=1)
    R = so3.exp(np.column_stack([np.zeros((len(own), 2)), turns[each, best]]))
    shifts = np.column_stack([centers[each, best], np.zeros(len(own))])
    found[told] = se3.pose(R, (R @ shifts[..., None])[..., 0])
    sure = told.copy()
    sure[told] = certain
    return found, sure


def _pad_points(points: Sequence[Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Points (n, M, 2) of all sheets, and which count (n, M): shorter lists are filled with their first point."""
    most = max(map(len, points))
    filled = np.stack([np.concatenate([own, np.tile(own[0], (most - len(own), 1))]) for own in points])
    return filled, np.arange(most) < np.array([[len(own)] for own in points])


def _register_shifts(
    points: Array, counted: NDArray[np.bool_], turns: Array, half: Array, rounds: int
) -> tuple[Array, Array]:
    """Where rectangles turned by (n, A) are nearest to points (n, M, 2) on their outlines, of which (n, M) count.

    Returns:
        Centres (n, A, 2) along the turned axes, and mean distances (n, A) of the points from the outlines, m.
    """
    c, s = np.cos(turns)[..., None], np.sin(turns)[..., None]
    x, y = points[:, None, :, 0], points[:, None, :, 1]
    turned = np.stack([c * x + s * y, c * y - s * x], axis=-1)
    counted = counted[:, None]
    centers = (turned.min(axis=2) + turned.max(axis=2)) / 2
    for _ in range(rounds):
        off, nearest = _offsets_from_sides(turned - centers[:, :, None], half)
        shifts = [_limited_mean(off[..., axis], counted & (nearest == axis)) for axis in (0, 1)]
        centers = centers + np.stack(shifts, axis=-1)
    off, nearest = _offsets_from_sides(turned - centers[:, :, None], half)
    distance = np.abs(np.where(nearest == 0, off[..., 0], off[..., 1]))
    return centers, _limited_mean(distance, np.broadcast_to(counted, distance.shape))


def _offsets_from_sides(points: Array, half: Array) -> tuple[Array, Index]:
    """Offsets (..., 2) of points from the nearer of two parallel sides, and across which axis the nearest is."""
    off = points - np.copysign(half, points)
    beside = np.maximum(np.abs(points) - half, 0)
    # Squared distances from both pairs of sides.
    far_x = off[..., 0] ** 2 + beside[..., 1] ** 2
    far_y = off[..., 1] ** 2 + beside[..., 0] ** 2
    return off, np.asarray(far_y < far_x, dtype=np.intp)


def _limited_mean(values: Array, counted: NDArray[np.bool_]) -> Array:
    """Means over the last axis of the counted ones of values, limited in size; 0 where there are none."""
    limited = np.clip(values, -_MAX_DISTANCE, _MAX_DISTANCE)
    return np.asarray(np.sum(limited * counted, axis=-1) / np.maximum(counted.sum(axis=-1), 1))

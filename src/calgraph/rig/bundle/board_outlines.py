"""Adds observations of the boards' outlines to a bundle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config import Rig
from calgraph.geometry import Array, Index, se3, so3
from calgraph.rig.bundle.board_observations import BoardObservation, board_number
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.outline_observations import OutlineObservations
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.systematic_parameters import add_outline_parameters
from calgraph.rig.pairs.board_matches import Candidates


def add_outlines(
    bundle: Bundle,
    state: BundleState,
    rig: Rig,
    detections: Mapping[str, Candidates],
    boards: Sequence[BoardObservation],
    bias_variance: float,
) -> tuple[Bundle, BundleState]:
    """The bundle with outline observations, and a state whose board poses fit them.

    Cameras measure the board's pose within its plane; without one, the board is registered by its outline, if
    this is unique.

    Args:
        bundle: planes and prints, solved.
        state: its solution.
        rig: with the boards' sizes.
        detections: of all sensors.
        boards: (C,) observed boards.
        bias_variance: initial variance of the outlines' view bias, m².
    """
    half_sizes = np.array([board.size for board in rig.boards]) / 2
    number = np.array([board_number(board, detections) for board in boards], dtype=np.intp)
    registered, half = number >= 0, half_sizes[np.maximum(number, 0)]
    edges = {
        s: OutlineObservations.from_edges(
            views.board.tolist(),
            [_surface_of(detections, boards[i], name) for i in views.board],
            half[views.board],
        )
        for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True))
        if isinstance(views, RangeObservations)
    }
    T_root_board = state.T_root_board.copy()
    if len(half_sizes) == 1:
        unregistered = np.flatnonzero(~registered)
        T_plane_board, registered[unregistered] = _register_boards(
            _edge_points(edges, state, unregistered), half_sizes[0]
        )
        T_root_board[unregistered] = T_root_board[unregistered] @ T_plane_board
    outlines = [outline.select(registered[outline.board]) for outline in edges.values()]
    outlines, parameters = add_outline_parameters(bundle, outlines, tuple(edges), rig, number)
    outlines = [
        outline.update_noise(relative_poses(state.T_root_sensor[s], T_root_board[outline.board]), 1.0)
        for s, outline in zip(edges, outlines, strict=True)
    ]
    views = [
        _bow_registered_boards(of_sensor, registered, relative_poses(T, T_root_board))
        if isinstance(of_sensor, RangeObservations)
        else of_sensor
        for of_sensor, T in zip(bundle.views, state.T_root_sensor, strict=True)
    ]
    bias_variances = np.zeros((len(outlines), bundle.bias_variance.shape[1]))
    bias_variances[:, 0] = bias_variance
    with_outlines = replace(
        bundle,
        views=tuple(views),
        outlines=tuple(outlines),
        outline_sensor=tuple(edges),
        bias_variance=np.concatenate([bundle.bias_variance, bias_variances]),
        extra_parameters=parameters,
    )
    extra = np.append(state.extra, np.zeros(len(parameters) - len(state.extra)))
    return with_outlines, replace(state, T_root_board=T_root_board, extra=extra)


def _bow_registered_boards(
    views: RangeObservations, registered: NDArray[np.bool_], T_sensor_board: Array
) -> RangeObservations:
    """The views of one scanner with the bow of registered boards (C,) along their sides, as cameras identify them.

    Args:
        views: with the mean curvature of boards that were not registered before.
        registered: (C,) whether the pose of each board in its plane is known.
        T_sensor_board: (C, 4, 4) of the boards.
    """
    now = views.registered | registered[views.board]
    if np.array_equal(now, views.registered):
        return views
    return replace(views, registered=now).update_noise(T_sensor_board[views.board], views.noise_scale)


def _surface_of(detections: Mapping[str, Candidates], board: BoardObservation, name: str) -> PlanePatch | Segment:
    detection = detections[name][board.capture][board.detection_index[name]]
    assert not isinstance(detection, BoardCorners)
    return detection


def _edge_points(edges: Mapping[int, OutlineObservations], state: BundleState, boards: Index) -> list[Array]:
    """Outline points (M, 2) of boards (n,) in their planes, from all scanners."""
    board, points = [np.zeros(0, dtype=np.intp)], [np.zeros((0, 2))]
    for s, outline in edges.items():
        T_sensor_board = relative_poses(state.T_root_sensor[s], state.T_root_board[outline.board])
        view, on_outline = outline.edge_points(T_sensor_board)
        board.append(outline.board[view])
        points.append(on_outline)
    all_boards, all_points = np.concatenate(board), np.concatenate(points)
    return [all_points[all_boards == i] for i in boards]


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
    _, distances = _register_shifts(padded, valid, angles, half, _COARSE_ITERATIONS)
    best = np.argmin(distances, axis=1)
    apart = np.abs((_COARSE_ANGLES - _COARSE_ANGLES[best, None] + np.pi / 2) % np.pi - np.pi / 2)
    second = np.where(apart > _MIN_ROTATION_APART, distances, np.inf).min(axis=1)
    unique = (distances[n, best] <= _MAX_MEAN_DISTANCE) & (second >= _AMBIGUITY_RATIO * distances[n, best])
    angles = _COARSE_ANGLES[best, None] + _FINE_ANGLES
    centers, distances = _register_shifts(padded, valid, angles, half, _FINE_ITERATIONS)
    best = np.argmin(distances, axis=1)
    R = so3.exp(np.column_stack([np.zeros((len(padded), 2)), angles[n, best]]))
    shifts = np.column_stack([centers[n, best], np.zeros(len(padded))])
    T[enough] = se3.pose(R, (R @ shifts[..., None])[..., 0])
    certain = enough.copy()
    certain[enough] = unique
    return T, certain


# Share of the boards with enough points to be registered by a size for this to be right, of several boards: one
# of 25 sizes fits a few by chance.
_MIN_REGISTERED_SHARE, _MIN_REGISTERED = 0.5, 5
# Errors of the half width and the half height that are tried if it is not, m: 10 cm of the size, in steps within
# which outlines are accepted.
_SIZE_ERRORS = np.arange(-2, 3) * 0.025


def _register_boards(points: Sequence[Array], half: Array) -> tuple[Array, NDArray[np.bool_]]:
    """As :func:`register_rectangles`; of the size near the stated one which most boards fit, if few fit that.

    The size that is tried gives the boards' poses only: the bundle estimates the error of the stated one. Of a
    board that is nearly square, another shape would decide about a rotation by 90° that edges do not show.
    """
    best = register_rectangles(points, half)
    enough = sum(len(p) >= _MIN_POINTS for p in points)
    needed = max(_MIN_REGISTERED_SHARE * enough, _MIN_REGISTERED)
    if enough >= needed > best[1].sum():
        square = abs(half[0] - half[1]) < np.ptp(_SIZE_ERRORS)
        errors = [np.array([x, y]) for x in _SIZE_ERRORS for y in _SIZE_ERRORS if x == y or not square]
        tried = (register_rectangles(points, half + error) for error in errors)
        other = max(tried, key=lambda one: int(one[1].sum()))
        return other if other[1].sum() >= needed else best
    return best


def _pad_points(points: Sequence[Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Points (n, M, 2) of all rectangles, padded by their first point, and which of them are valid (n, M)."""
    most = max(map(len, points))
    padded = np.stack([np.concatenate([p, np.tile(p[0], (most - len(p), 1))]) for p in points])
    return padded, np.arange(most) < np.array([[len(p)] for p in points])


def _register_shifts(
    points: Array, valid: NDArray[np.bool_], angles: Array, half: Array, rounds: int
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
        shifts = [_limited_mean(off[..., axis], valid & (nearest == axis)) for axis in (0, 1)]
        centers = centers + np.stack(shifts, axis=-1)
    off, nearest = _offsets_from_sides(rotated - centers[:, :, None], half)
    distance = np.abs(np.where(nearest == 0, off[..., 0], off[..., 1]))
    return centers, _limited_mean(distance, np.broadcast_to(valid, distance.shape))


def _offsets_from_sides(points: Array, half: Array) -> tuple[Array, Index]:
    """Offsets (..., 2) of points from the nearer of two parallel sides, and the axis across the nearest side."""
    off = points - np.copysign(half, points)
    beside = np.maximum(np.abs(points) - half, 0)
    # Squared distances from both pairs of sides.
    far_x = off[..., 0] ** 2 + beside[..., 1] ** 2
    far_y = off[..., 1] ** 2 + beside[..., 0] ** 2
    return off, np.asarray(far_y < far_x, dtype=np.intp)


def _limited_mean(values: Array, valid: NDArray[np.bool_]) -> Array:
    """Means over the last axis of the valid values, truncated; 0 where there are none."""
    limited = np.clip(values, -_MAX_DISTANCE, _MAX_DISTANCE)
    return np.asarray(np.sum(limited * valid, axis=-1) / np.maximum(valid.sum(axis=-1), 1))

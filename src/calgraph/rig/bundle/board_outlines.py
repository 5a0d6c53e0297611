"""Adds observations of the boards' outlines to a bundle."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config import Rig
from calgraph.geometry import Array, Index
from calgraph.rig.bundle.board_observations import BoardObservation, board_number
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.outline_observations import OutlineObservations
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.rectangle_registration import register_rectangles
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
        T_plane_board, registered[unregistered] = register_rectangles(
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

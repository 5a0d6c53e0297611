"""Adds observations of the boards' outlines to a bundle, and drops those that contradict the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from calgraph.config import Rig
from calgraph.detection import BoardCorners, PlanePatch, Segment
from calgraph.estimation.rig.board_observations import BoardObservation, board_number
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, ExtraParameter, MinimizedBundle
from calgraph.estimation.rig.covariances import parameter_covariance, pose_covariance
from calgraph.estimation.rig.observations import RangeObservations, relative_poses
from calgraph.estimation.rig.outline_observations import OutlineObservations
from calgraph.estimation.rig.rectangle_registration import register_rectangles
from calgraph.geometry import Array, Index, se3
from calgraph.pairwise import Candidates


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
    settings = bundle.settings.outlines
    half_sizes = np.array([board.size for board in rig.boards]) / 2
    number = np.array([board_number(board, detections) for board in boards], dtype=np.intp)
    registered, half = number >= 0, half_sizes[np.maximum(number, 0)]
    edges = {
        s: OutlineObservations.from_edges(
            views.board.tolist(),
            [_surface_of(detections, boards[i], name) for i in views.board],
            half[views.board],
            settings,
        )
        for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True))
        if isinstance(views, RangeObservations)
    }
    T_root_board = state.T_root_board.copy()
    if len(half_sizes) == 1:
        unregistered = np.flatnonzero(~registered)
        T_plane_board, registered[unregistered] = register_rectangles(
            _edge_points(edges, state, unregistered), half_sizes[0], bundle.settings.registration
        )
        T_root_board[unregistered] = T_root_board[unregistered] @ T_plane_board
    outlines: list[OutlineObservations] = []
    offsets: list[ExtraParameter] = []
    for s, observed in edges.items():
        outline = observed.select(registered[observed.board])
        view_set = len(bundle.sensors) + len(outlines)
        offsets.append(ExtraParameter(bundle.sensors[s], "outline", "m", 0.0, settings.offset_stddev, (view_set,)))
        T_sensor_board = relative_poses(state.T_root_sensor[s], T_root_board[outline.board])
        outlines.append(outline.update_noise(T_sensor_board, 1.0))
    with_outlines = replace(
        bundle,
        outlines=tuple(outlines),
        outline_sensor=tuple(edges),
        bias_variance=np.append(bundle.bias_variance, np.full(len(outlines), bias_variance)),
        extra_parameters=(*bundle.extra_parameters, *offsets),
    )
    extra = np.append(state.extra, np.zeros(len(offsets)))
    return with_outlines, replace(state, T_root_board=T_root_board, extra=extra)


def drop_wrong_outlines(bundle: Bundle, solution: MinimizedBundle) -> tuple[Bundle, tuple[str, ...]]:
    """The bundle without outlines that are not those of a board of the stated size; the reason for each."""
    stddev = np.sqrt(np.diag(parameter_covariance(solution.equations)))[6 * bundle.body_count :]
    settings = bundle.settings.outlines
    outlines, remarks = [], []
    for k, outline in enumerate(bundle.outlines, start=len(bundle.views)):
        name, index = bundle.sensors[bundle.sensor_of(k)], bundle.extra_indices(k)
        offset, sigma = float(solution.state.extra[index].sum()), float(stddev[index].sum())
        why = ""
        if abs(offset) > max(settings.max_offset, settings.max_offset_sigmas * sigma):
            where = "outside" if offset > 0 else "inside"
            why = f"{1000 * abs(offset):.0f} mm {where} the target's size on average"
        elif outline.noise_scale > settings.max_noise_ratio:
            why = f"{outline.noise_scale:.1f} times as far from its sides as expected from their noise"
        if why:
            remarks.append(f"board edges in scans of {name} are {why}: not used; is `size` the board's?")
        outlines.append(outline.select(np.full(len(outline.board), not why)))
    return bundle.with_views([*bundle.views, *outlines]), tuple(remarks)


def outlines_contradict(
    without: tuple[Bundle, MinimizedBundle], with_outlines: tuple[Bundle, MinimizedBundle]
) -> bool:
    """Whether outlines change the sensors' poses by more than noise explains.

    Two solutions, one from a subset of the other's measurements, differ by ``d`` with covariance ``P - Q``; this
    is tested in the directions in which outlines reduce the variance.

    Source: Hausman, "Specification tests in econometrics", Econometrica 1978.

    Args:
        without: the bundle without outlines, and its solution.
        with_outlines: the same with them.
    """
    (P, T), (Q, T_outlines) = (
        (pose_covariance(b, s.state, s.equations), s.state.T_root_sensor) for b, s in (without, with_outlines)
    )
    settings = with_outlines[0].settings.outlines
    d = se3.difference(T_outlines, T).ravel()
    free = np.diag(P) > 0
    whiten = np.linalg.inv(np.linalg.cholesky(P[np.ix_(free, free)]))
    share, directions = np.linalg.eigh(whiten @ Q[np.ix_(free, free)] @ whiten.T)
    tested = share < 1 - settings.min_variance_share
    squares = (directions.T @ whiten @ d[free])[tested] ** 2 / (1 - share[tested])
    return bool(np.sum(squares) > chdtri(max(np.sum(tested), 1), settings.contradiction_significance))


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

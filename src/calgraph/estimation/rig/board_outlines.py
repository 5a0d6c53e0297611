"""Lays the sheets of boards where scanners saw them end, and hangs these ends on a bundle as outlines."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from calgraph.config import Rig
from calgraph.detection import BoardCorners, PlanePatch, Segment
from calgraph.estimation.rig.board_observations import BoardObservation, detections_of
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, ExtraParameter, MinimizedBundle
from calgraph.estimation.rig.covariances import parameter_covariance, pose_covariance
from calgraph.estimation.rig.observations import RangeObservations, relative_poses
from calgraph.estimation.rig.outline_observations import OutlineObservations
from calgraph.estimation.rig.rectangle_registration import register_rectangles
from calgraph.geometry import Array, Index, se3
from calgraph.pairwise import Candidates

# Standard deviation of how much too far out a scanner may see a sheet end, m, before anything is measured.
_OUTLINE_OFFSET_STDDEV = 0.01
# Sheets whose sides are farther out than this, m, and surely so, are cut otherwise than the target's size says.
_MAX_OUTLINE_OFFSET, _OFFSET_SIGMAS = 0.012, 4.0
# Edges that scatter by so many times their noise are not those of a rectangle of this size.
_MAX_OUTLINE_NOISE_SCALE = 3.0
# Directions of which outlines take less than this share of the variance are not told by them.
_MIN_VARIANCE_SHARE = 0.05
# Outlines contradict planes and prints if chance would have them differ so once in so many.
_CONTRADICTION_CHANCE = 1e-4


def add_outlines(
    bundle: Bundle,
    state: BundleState,
    rig: Rig,
    seen: Mapping[str, Candidates],
    boards: Sequence[BoardObservation],
    sway: float,
) -> tuple[Bundle, BundleState]:
    """The bundle with where scanners saw sheets end, and a state in which sheets lie about there.

    Cameras know how the sheet lies; without one, it is laid by its outline, if enough of that was seen and of one
    way only.

    Args:
        bundle: planes and prints, solved.
        state: where they are.
        rig: the sheets' sizes.
        seen: all detections.
        boards: (C,) that were sighted.
        sway: that outlines begin with, m².
    """
    size = np.array([board.size for board in rig.boards]) / 2
    printed = np.array([_board_number(board, seen) for board in boards], dtype=np.intp)
    lies, half = printed >= 0, size[np.maximum(printed, 0)]
    ends = {
        s: OutlineObservations.from_detections(
            views.board.tolist(), [_surface_of(seen, boards[i], name) for i in views.board], half[views.board]
        )
        for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True))
        if isinstance(views, RangeObservations)
    }
    T_root_board = state.T_root_board.copy()
    if len(size) == 1:
        lost = np.flatnonzero(~lies)
        in_planes, lies[lost] = register_rectangles(_edge_points(ends, state, lost), size[0])
        T_root_board[lost] = T_root_board[lost] @ in_planes
    placed = replace(state, T_root_board=T_root_board)
    outlines: list[OutlineObservations] = []
    unknowns: list[ExtraParameter] = []
    for s, seen_ends in ends.items():
        outline = seen_ends.select(lies[seen_ends.board])
        T_sensor_board = relative_poses(state.T_root_sensor[s], T_root_board[outline.board])
        unknowns.append(
            ExtraParameter(
                bundle.sensors[s],
                "outline",
                "m",
                0.0,
                _OUTLINE_OFFSET_STDDEV,
                (len(bundle.sensors) + len(outlines),),
            )
        )
        outlines.append(outline.update_noise(T_sensor_board, 1.0))
    several = replace(
        bundle,
        outlines=tuple(outlines),
        outline_sensor=tuple(ends),
        bias_variance=np.append(bundle.bias_variance, np.full(len(outlines), sway)),
        extra_parameters=(*bundle.extra_parameters, *unknowns),
    )
    return several, replace(placed, extra=np.append(state.extra, np.zeros(len(unknowns))))


def drop_wrong_outlines(bundle: Bundle, solved: MinimizedBundle) -> tuple[Bundle, tuple[str, ...]]:
    """The bundle without the outlines that are not those of sheets of the stated size; and of each, why."""
    spread = np.sqrt(np.diag(parameter_covariance(solved.equations)))[6 * bundle.body_count :]
    outlines, remarks = [], []
    for k, outline in enumerate(bundle.outlines, start=len(bundle.views)):
        name, own = bundle.sensors[bundle.sensor_of(k)], bundle.extra_indices(k)
        growth, doubt = float(solved.state.extra[own].sum()), float(spread[own].sum())
        why = ""
        if abs(growth) > _MAX_OUTLINE_OFFSET and abs(growth) > _OFFSET_SIGMAS * doubt:
            where = "outside" if growth > 0 else "inside"
            why = f"{1000 * abs(growth):.0f} mm {where} the target's size on average"
        elif outline.noise_scale > _MAX_OUTLINE_NOISE_SCALE:
            why = f"{outline.noise_scale:.1f} times as far from its sides as their noise explains"
        if why:
            remarks.append(f"{name} sees the board's edges {why}: they are not used; is size the sheet's?")
        outlines.append(outline.select(np.full(len(outline.board), not why)))
    return bundle.with_views([*bundle.views, *outlines]), tuple(remarks)


def outlines_contradict(plain: tuple[Bundle, MinimizedBundle], outlined: tuple[Bundle, MinimizedBundle]) -> bool:
    """Whether outlines have sensors elsewhere than planes and prints do, by more than chance explains.

    A solution from fewer measurements differs from one that also has others by ``d``, which has the covariance
    ``P - Q`` of the two; it is tested in those directions in which outlines tell something.

    Source: Hausman, "Specification tests in econometrics", Econometrica 1978.

    Args:
        plain: the bundle without outlines, solved.
        outlined: the same one with them, solved.
    """
    (P, T), (Q, T_outlined) = (
        (pose_covariance(b, s.state, s.equations), s.state.T_root_sensor) for b, s in (plain, outlined)
    )
    d = se3.difference(T_outlined, T).ravel()
    free = np.diag(P) > 0
    whiten = np.linalg.inv(np.linalg.cholesky(P[np.ix_(free, free)]))
    kept, directions = np.linalg.eigh(whiten @ Q[np.ix_(free, free)] @ whiten.T)
    told = kept < 1 - _MIN_VARIANCE_SHARE
    squares = (directions.T @ whiten @ d[free])[told] ** 2 / (1 - kept[told])
    return bool(np.sum(squares) > chdtri(max(np.sum(told), 1), _CONTRADICTION_CHANCE))


def _surface_of(seen: Mapping[str, Candidates], board: BoardObservation, name: str) -> PlanePatch | Segment:
    found = seen[name][board.capture][board.detection_index[name]]
    assert not isinstance(found, BoardCorners)
    return found


def _board_number(board: BoardObservation, seen: Mapping[str, Candidates]) -> int:
    """Which of the rig's boards cameras saw; -1 where none did."""
    return next((d.board for _, d in detections_of(board, seen) if isinstance(d, BoardCorners)), -1)


def _edge_points(ends: Mapping[int, OutlineObservations], state: BundleState, boards: Index) -> list[Array]:
    """Of some boards (n,), the points (M, 2) in their planes where scanners, by number, saw them end."""
    board, points = [np.zeros(0, dtype=np.intp)], [np.zeros((0, 2))]
    for s, outline in ends.items():
        view, found = outline.edge_points(
            relative_poses(state.T_root_sensor[s], state.T_root_board[outline.board])
        )
        board.append(outline.board[view])
        points.append(found)
    of, all_points = np.concatenate(board), np.concatenate(points)
    return [all_points[of == i] for i in boards]

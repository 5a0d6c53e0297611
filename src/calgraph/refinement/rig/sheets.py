"""Lays the sheets of boards where scanners saw them end, and hangs these ends on a bundle as outlines."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.detection import BoardCorners, PlanePatch, Segment
from calgraph.geometry import Array, Index, se3, so3
from calgraph.pairwise import Candidates
from calgraph.refinement.rig.boards import Sighting, seen_in
from calgraph.refinement.rig.bundle import Bundle, Solved, State, Unknown, covariance, reduced_covariance
from calgraph.refinement.rig.outlines import Outline, middles
from calgraph.refinement.rig.views import Beams, relative
from calgraph.rig import Rig

# Standard deviation of how much too far out a scanner may see a sheet end, m, before anything is measured.
_GROWTH = 0.01
# Sheets whose sides are farther out than this, m, and surely so, are cut otherwise than the target's size says.
_WRONG_SIZE, _SURE = 0.012, 4.0
# Edges that scatter by so many times their noise are not those of a rectangle of this size.
_SHAPELESS = 3.0
# So many edges are needed to lay a sheet by them alone.
_ENOUGH = 6
# Directions of which outlines take less than this share of the variance are not told by them.
_TOLD = 0.05
# Outlines contradict planes and prints if chance would have them differ so once in so many.
_CHANCE = 1e-4
_TURNS = np.radians(np.arange(0.0, 180.0, 5.0))
_FINE = np.radians(np.arange(-4.0, 4.5, 1.0))
_SHIFTS = 6
# Of an edge the distance counts up to this, m.
_FAR = 0.05
# A sheet is laid right if edges are on average as near to its sides as this, m; turned otherwise, so much worse.
_NEAR, _WORSE = 0.02, 1.5

_log = logging.getLogger(__name__)


def with_outlines(
    bundle: Bundle, state: State, rig: Rig, seen: Mapping[str, Candidates], boards: Sequence[Sighting], sway: float
) -> tuple[Bundle, State]:
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
    half, lies, T_root_board = (
        np.zeros((len(boards), 2)),
        np.zeros(len(boards), dtype=bool),
        state.T_root_board.copy(),
    )
    for i, board in enumerate(boards):
        prints = [d.board for _, d in seen_in(board, seen) if isinstance(d, BoardCorners)]
        if prints:
            half[i], lies[i] = size[prints[0]], True
        elif len(size) == 1:
            T = _laid(T_root_board[i], list(_edges_of(board, seen, bundle, state)), size[0])
            half[i], lies[i] = size[0], T is not None
            T_root_board[i] = T_root_board[i] if T is None else T
    placed = replace(state, T_root_board=T_root_board)
    outlines: list[Outline] = []
    outlined: list[int] = []
    unknowns: list[Unknown] = []
    for s, (name, views) in enumerate(zip(bundle.names, bundle.views, strict=True)):
        if isinstance(views, Beams):
            own = views.board[lies[views.board]]
            found = [_surface(seen, boards[i], name) for i in own]
            outline = Outline.of(own.tolist(), found, half[own])
            outline = outline.weighed(relative(state.T_root_sensor[s], T_root_board[own]), 1.0)
            unknowns.append(Unknown(name, "outline", "m", 0.0, _GROWTH, (len(bundle.names) + len(outlines),)))
            outlined.append(s)
            outlines.append(outline)
    several = replace(
        bundle,
        outlines=tuple(outlines),
        outlined=tuple(outlined),
        sway=np.append(bundle.sway, np.full(len(outlines), sway)),
        unknowns=(*bundle.unknowns, *unknowns),
    )
    return several, replace(placed, own=np.append(state.own, np.zeros(len(unknowns))))


def without_wrong_outlines(bundle: Bundle, solved: Solved) -> Bundle:
    """The bundle without the outlines that are not those of sheets of the stated size; each is logged."""
    spread = np.sqrt(np.diag(reduced_covariance(solved.system)))[6 * bundle.bodies :]
    outlines = []
    for k, outline in enumerate(bundle.outlines, start=len(bundle.views)):
        name, own = bundle.names[bundle.seer(k)], bundle.own(k)
        growth, doubt = float(solved.state.own[own].sum()), float(spread[own].sum())
        why = ""
        if abs(growth) > _WRONG_SIZE and abs(growth) > _SURE * doubt:
            where = "outside" if growth > 0 else "inside"
            why = f"{1000 * abs(growth):.0f} mm {where} the target's size on average"
        elif outline.scale > _SHAPELESS:
            why = f"{outline.scale:.1f} times as far from its sides as their noise explains"
        if why:
            _log.warning("%s sees the board's edges %s: they are not used; is size the sheet's?", name, why)
        outlines.append(outline.where(np.full(len(outline.board), not why)))
    return bundle.with_views([*bundle.views, *outlines])


def contradict(plain: tuple[Bundle, Solved], outlined: tuple[Bundle, Solved]) -> bool:
    """Whether outlines have sensors elsewhere than planes and prints do, by more than chance explains.

    A solution from fewer measurements differs from one that also has others by ``d``, which has the covariance
    ``P - Q`` of the two; it is tested in those directions in which outlines tell something.

    Source: Hausman, "Specification tests in econometrics", Econometrica 1978.

    Args:
        plain: the bundle without outlines, solved.
        outlined: the same one with them, solved.
    """
    (P, T), (Q, T_outlined) = (
        (covariance(b, s.state, s.system), s.state.T_root_sensor) for b, s in (plain, outlined)
    )
    d = se3.difference(T_outlined, T).ravel()
    free = np.diag(P) > 0
    whiten = np.linalg.inv(np.linalg.cholesky(P[np.ix_(free, free)]))
    kept, directions = np.linalg.eigh(whiten @ Q[np.ix_(free, free)] @ whiten.T)
    told = kept < 1 - _TOLD
    squares = (directions.T @ whiten @ d[free])[told] ** 2 / (1 - kept[told])
    return bool(np.sum(squares) > chdtri(max(np.sum(told), 1), _CHANCE))


def _surface(seen: Mapping[str, Candidates], board: Sighting, name: str) -> PlanePatch | Segment:
    found = seen[name][board.capture][board.seen[name]]
    assert not isinstance(found, BoardCorners)
    return found


def _edges_of(
    board: Sighting, seen: Mapping[str, Candidates], bundle: Bundle, state: State
) -> Iterator[tuple[Array, Array]]:
    """``T_root_sensor`` (4, 4) of the scanners that saw a board, and where they saw it end (M, 2, 3)."""
    for name, detection in seen_in(board, seen):
        if not isinstance(detection, BoardCorners):
            yield state.T_root_sensor[bundle.names.index(name)], detection.edges


def _laid(T_root_board: Array, edges: Sequence[tuple[Array, Array]], half: Array) -> Array | None:
    """The pose (4, 4) with the sheet turned and shifted in its plane to where it was seen to end.

    Args:
        T_root_board: its plane, and about its centre.
        edges: ``T_root_sensor`` (4, 4) and pairs of beams (M, 2, 3), of each sensor.
        half: (2,) half its size, m.
    """
    points = np.concatenate([np.empty((0, 2)), *(middles(relative(T, T_root_board), pairs) for T, pairs in edges)])
    if len(points) < _ENOUGH:
        return None
    centers, misses = _shifted(points, _TURNS, half)
    best = int(np.argmin(misses))
    apart = np.abs((_TURNS - _TURNS[best] + np.pi / 2) % np.pi - np.pi / 2)
    if misses[best] > _NEAR or misses[apart > np.radians(20)].min() < _WORSE * misses[best]:
        return None
    turns = _TURNS[best] + _FINE
    centers, misses = _shifted(points, turns, half)
    best = int(np.argmin(misses))
    R = so3.exp(np.array([0.0, 0.0, turns[best]]))
    return np.asarray(T_root_board @ se3.pose(R, R @ np.append(centers[best], 0.0)))


def _shifted(points: Array, turns: Array, half: Array) -> tuple[Array, Array]:
    """Where rectangles turned by (A,) are nearest to points (M, 2) on their outlines.

    Returns:
        Centres (A, 2) along the turned axes, and mean distances (A,) of the points from the outlines, m.
    """
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    turned = np.stack([c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]], axis=-1)
    centers = (turned.min(axis=1) + turned.max(axis=1)) / 2
    for _ in range(_SHIFTS):
        off, nearest = _from_sides(turned - centers[:, None], half)
        centers = centers + np.stack([_mean(off[..., axis], nearest == axis) for axis in (0, 1)], axis=-1)
    off, nearest = _from_sides(turned - centers[:, None], half)
    distance = np.abs(np.take_along_axis(off, nearest[..., None], axis=-1)[..., 0])
    return centers, np.minimum(distance, _FAR).mean(axis=1)


def _from_sides(points: Array, half: Array) -> tuple[Array, Index]:
    """Offsets (..., 2) of points from the nearer of two parallel sides, and across which axis the nearest is."""
    off = points - np.copysign(half, points)
    beside = np.maximum(np.abs(points) - half, 0)[..., ::-1]
    return off, np.argmin(np.hypot(off, beside), axis=-1)


def _mean(values: Array, counted: NDArray[np.bool_]) -> Array:
    """Means (A,) of the counted ones of values (A, M), limited in size; 0 where there are none."""
    limited = np.clip(values, -_FAR, _FAR)
    return np.asarray(np.sum(limited * counted, axis=1) / np.maximum(counted.sum(axis=1), 1))

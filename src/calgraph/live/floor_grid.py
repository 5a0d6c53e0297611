"""The floor of a network in cells: walls, where people walked, and where they should still walk."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, uniform_filter

from calgraph.geometry import Array, se2
from calgraph.network.pairs.visibility_map import BACKGROUND_MARGIN, MAX_BEAM_GAP, MIN_RANGE, RANGE_TAIL
from calgraph.result import Calibration, FloorView
from calgraph.result.finding import split_clauses
from calgraph.verdict.grades import names_sources

Cells = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """Cells of the floor plan."""

    origin: Array
    """(2,) corner of the first cell, m."""
    cell: float
    """Width of a cell, m."""
    walked: Cells
    """(X, Y) where people walked."""
    wanted: Cells
    """(X, Y) where they should still walk: in views that others share, of scanners whose poses walks improve."""
    walls: Array
    """(W, 2) points of the static background, m."""


# Width of the cells of the floor plan, m: half of a person's. Large plans have wider ones.
_CELL = 0.25
# Maximum number of cells along the longer side of the floor plan: 4 px each on a phone.
_MAX_CELLS = 80
# Maximum number of points of the static background in the floor plan: 14 kB.
_MAX_WALL_POINTS = 1400


def build_floor_grid(calibration: Calibration) -> FloorGrid | None:
    """The floor in the views of the connected sensors of a network; None as long as there are none."""
    views = calibration.pictures.floor_views
    if len(views) < 2:
        return None
    poses = [_place_on_plan(calibration, view.sensor) for view in views]
    walls = np.concatenate([view.background for view in views])
    everything = np.concatenate(
        [walls, *(track for view in views for track in view.tracks), *(T[None, :2, 2] for T in poses)]
    )
    low, high = np.min(everything, axis=0), np.max(everything, axis=0)
    cell = max(_CELL, float(np.max(high - low)) / _MAX_CELLS)
    shape = tuple(int(n) for n in np.ceil((high - low) / cell) + 1)
    seconds = _sum_walking_time(views, low, cell, shape)
    x = low + cell * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5)
    observed = {
        view.sensor: _find_observed_cells(T, view, x.reshape(-1, 2)).reshape(shape)
        for T, view in zip(poses, views, strict=True)
    }
    verdicts = {name: calibration[name].verdict for name in observed}
    unfinished = [name for name, one in verdicts.items() if one.grade != "good" and is_helped_by_walks(one.reason)]
    return FloorGrid(
        low,
        cell,
        seconds > 0,
        _select_wanted(observed, unfinished, seconds, cell, unconnected=bool(calibration.evidence.unconnected)),
        _thin(walls, cell / 2, _MAX_WALL_POINTS),
    )


def is_helped_by_walks(reason: str) -> bool:
    """Whether the reason of a verdict names no source of the errors, or advises to have people walk.

    Advice on sources is the last clause; findings, which come before, may have their own.
    """
    clauses = split_clauses(reason)
    return not any(map(names_sources, clauses)) or "let people" in reason or "people who walk" in clauses[-1]


def _place_on_plan(calibration: Calibration, name: str) -> Array:
    """(3, 3) pose of a sensor on the plan."""
    T = calibration.pictures.T_plan_root @ calibration[name].T_root_sensor
    return se2.pose(float(np.arctan2(T[1, 0], T[0, 0])), T[:2, 3])


def _sum_walking_time(views: Sequence[FloorView], low: Array, cell: float, shape: tuple[int, ...]) -> Array:
    """(X, Y) the longest time that a sensor tracked people in each cell, s."""
    longest = np.zeros(shape)
    for view in views:
        seconds = np.zeros(shape)
        for times, track in zip(view.times, view.tracks, strict=True):
            cells = ((track - low) / cell).astype(np.intp)
            np.add.at(seconds, tuple(cells.T), np.gradient(times) if len(times) > 1 else 0.0)
        longest = np.maximum(longest, seconds)
    return longest


# Range within which scanners detect people reliably, m: nine beams of 0.5 degrees; more if they have tracked
# people farther away.
_WALK_RANGE = 8.0


def _find_observed_cells(T: Array, view: FloorView, x: Array) -> Cells:
    """(N,) in which of the positions (N, 2) of the plan the sensor at a pose would detect a person."""
    inside = se2.apply(se2.inverse(T), x)
    distance = np.linalg.norm(inside, axis=1)
    background = se2.apply(se2.inverse(T), view.background)
    limit = _find_free_range(background, np.arctan2(inside[:, 1], inside[:, 0]), MAX_BEAM_GAP)
    ranges = [np.linalg.norm(track - T[:2, 2], axis=1) for track in view.tracks]
    usual = float(np.quantile(np.concatenate(ranges), 1 - RANGE_TAIL)) if ranges else 0.0
    limit = np.minimum(limit - BACKGROUND_MARGIN, max(usual, _WALK_RANGE))
    return np.asarray((distance > MIN_RANGE) & (distance < limit))


def _find_free_range(background: Array, bearing: Array, max_gap: float) -> Array:
    """Range (N,) up to which nothing static is in view at bearings (N,), m: infinite where beams return nothing.

    Beams between which there is a gap ended beyond the scanner's range, or in the one behind it: between the first
    and the last background point they are in view.
    """
    if not len(background):
        return np.zeros(len(bearing))
    at, ranges = np.arctan2(background[:, 1], background[:, 0]), np.linalg.norm(background, axis=1)
    bins = np.arange(-np.pi, np.pi + max_gap, max_gap)
    nearest = np.full(len(bins), np.inf)
    np.minimum.at(nearest, np.digitize(at, bins) - 1, ranges)
    in_view = (bearing >= at.min()) & (bearing <= at.max())
    return np.where(in_view, nearest[np.digitize(bearing, bins) - 1], 0.0)


# Time that people spend within one cell's width of a cell from which it counts as walked, s: one passage at 1.2
# m/s takes 0.6 s.
_MIN_WALKED = 0.5
# Minimum size of an area where people are asked to walk, m².
_MIN_AREA = 1.0


def _select_wanted(
    observed: Mapping[str, Cells], unfinished: Collection[str], seconds: Array, cell: float, *, unconnected: bool
) -> Cells:
    """Where people should walk next."""
    # A person covers the cells around; a mean over 3 x 3 cells times 9 is their sum.
    around = 9 * uniform_filter(seconds, 3, mode="constant")
    wanted = np.zeros(seconds.shape, dtype=np.bool_)
    if unconnected:
        # Their views are unknown: people should go where none has been.
        wanted |= np.any(list(observed.values()), axis=0) & (around == 0)
    for name in unfinished:
        others = np.any([cells for other, cells in observed.items() if other != name], axis=0)
        shared = observed[name] & others
        if not shared.any():
            continue
        chosen = shared & (around < _MIN_WALKED)
        if np.sum(chosen) * cell**2 < _MIN_AREA:
            # All of it has been walked: where that was least.
            chosen = shared & (around <= np.quantile(around[shared], 1 / 3))
        wanted |= chosen
    return _remove_small_areas(wanted, _MIN_AREA / cell**2)


def _remove_small_areas(cells: Cells, min_cells: float) -> Cells:
    numbers, _ = label(cells)
    counts = np.bincount(numbers.ravel())
    return np.asarray(cells & (counts[numbers] >= min_cells))


def _thin(points: Array, width: float, limit: int) -> Array:
    """At most ``limit`` of points (N, 2), evenly chosen from one in each square of a width."""
    _, first = np.unique(np.round(points / width).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)[:: ceil(len(first) / limit) or 1]])

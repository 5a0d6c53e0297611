"""What stands still in the clouds of a stationary 3-D LiDAR, and what moves before it, in one pass.

Directions are cells of azimuth and elevation, so that spinning LiDARs and those whose pattern does not repeat are
the same. A cell has a histogram of ranges; a range that a good share of its measurements have is static.

Whether a sensor moved shows in its pose after a moment relative to that before. If it moves by t and turns by r,
the range of a point p on a plane with normal n, along the beam u, changes by ``-(n · t + (p x n) · r) / (n · u)``.
Least squares over all directions give t and r, with the weights of Student's t for what moved itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.special import chdtri

from calgraph.geometry import Array, Index, join_rows, select_rows
from calgraph.network.space.observations import StaticPoints, StaticStep
from calgraph.sensors import PointCloud
from calgraph.solver.clustered_covariance import SCATTER_FACTOR
from calgraph.surfaces.surface_points import fit_surfaces

# Least measurements of a direction before and after a step, and least number of such directions.
_MIN_MEASUREMENTS, _MIN_DIRECTIONS = 8, 200
# Standard deviation of surfaces that are planes, and distance up to which points are on them, m.
_THICKNESS, _NEAR = 0.03, 0.09
# Standard deviation of a point from its surface beside the noise of ranges, m, assumed: at grazing incidence that
# noise is next to nothing across the surface.
_SURFACE_STDDEV = 0.0005
# Degrees of freedom of Student's t, and fits with weights from the residuals of the one before.
_FREEDOM, _ROUNDS = 4.0, 8
# Probability with which a step is found where there is none, by errors that are independent.
_FALSE_ALARM = 0.001
# Steps that count, m and rad (0.03°): half of it is an error of the pose, which is known to some millimetres.
# Simulated sensors that rest, 50 of them, beside glass, stairs and crowds, have steps of up to 0.8 mm and 0.007°.
_MIN_SHIFT, _MIN_TURN = 0.002, float(np.radians(0.03))


def find_step(static: StaticPoints, count: Array, total: Array, begin: Array) -> StaticStep | None:
    """The most significant step between periods, if there is one that counts.

    Args:
        static: of N directions.
        count: (K, N) measurements of these in each period.
        total: (K, N) sums of their ranges, m.
        begin: (K,) of periods, s.
    """
    surfaces = fit_surfaces(static.points, np.zeros(len(static.points), dtype=np.intp), _THICKNESS)
    cell = surfaces.find(static.points)
    on = np.flatnonzero(cell >= 0)
    distance = np.einsum("ni,ni->n", static.points[on] - surfaces.center[cell[on]], surfaces.normals[cell[on]])
    on = on[np.abs(distance) < _NEAR]
    points, normals = static.points[on], surfaces.normals[cell[on]]
    incidence = np.einsum("ni,ni->n", points, normals) / np.linalg.norm(points, axis=1)
    by_motion = -np.column_stack([normals, np.cross(points, normals)])
    count, total = np.cumsum(count[:, on], axis=0), np.cumsum(total[:, on], axis=0)
    found, largest = None, SCATTER_FACTOR * float(chdtri(6, _FALSE_ALARM))
    for k in range(len(begin) - 1):
        n_before, n_after = count[k], count[-1] - count[k]
        used = np.flatnonzero((n_before >= _MIN_MEASUREMENTS) & (n_after >= _MIN_MEASUREMENTS))
        if len(used) < _MIN_DIRECTIONS:
            continue
        n_before, n_after = n_before[used], n_after[used]
        change = (total[-1] - total[k])[used] / n_after - total[k, used] / n_before
        noise = static.stddev[on[used]] * np.sqrt(1 / n_before + 1 / n_after)
        stddev = np.hypot(incidence[used] * noise, _SURFACE_STDDEV)
        step, information = _fit_robustly(by_motion[used], incidence[used] * change, stddev)
        significance = float(step @ information @ step)
        shift, turn = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
        if significance > largest and (shift > _MIN_SHIFT or turn > _MIN_TURN):
            found, largest = StaticStep(float(begin[k + 1]), shift, turn), significance
    return found


def _fit_robustly(A: Array, b: Array, stddev: Array) -> tuple[Array, Array]:
    """The solution (6,) of ``A x = b`` with errors of Student's t, and its information (6, 6)."""
    weight = np.ones(len(b))
    for _ in range(_ROUNDS):
        weighted = A * (weight / stddev**2)[:, None]
        information = weighted.T @ A + np.eye(6)
        x = np.linalg.solve(information, weighted.T @ b)
        weight = (_FREEDOM + 1) / (_FREEDOM + ((b - A @ x) / stddev) ** 2)
    return np.asarray(x), np.asarray(information)


# Edge of a cell, rad (0.4°): less than the distance of rings of most LiDARs, and at least one beam of a sweep.
_CELL = float(np.radians(0.4))
_AZIMUTHS, _ELEVATIONS = round(2 * np.pi / _CELL), round(np.pi / _CELL)
# Nearer points are of the mounting, m; farther ones meet people with too few beams. People are farther than twice
# that: the wall that carries a sensor is measured sometimes only, where it is at the limit.
_MIN_RANGE, _MAX_RANGE, _MIN_MOVING = 0.5, 80.0, 1.0
# A bin of ranges is 0.12 m wide at 0 m, and 1.2 % wider by each metre: the same in logarithms of (10 m + range).
_BIN_STRETCH, _BIN_ORIGIN = 1 / 0.012, 10.0
_BINS = int(np.log1p(_MAX_RANGE / _BIN_ORIGIN) * _BIN_STRETCH) + 3
# Of the sweeps, every third is counted: 10 s at 10 Hz have 33 measurements of a direction then.
_COUNTED = 3
# Points that are held before they are split in static and moving ones: 60 MB. Of VLP-16 they are 10 s.
_HELD_POINTS = 3_000_000
# Share of measurements of a direction that make a range static: people cross a beam in less. While sweeps are
# still read, only what more than half of them have is dropped.
_STATIC_SHARE, _SURE_SHARE = 0.25, 0.5
# Measurements of a direction count as at least this share of a usual direction's: where nothing returns beams,
# people who cross it are all that it measures.
_LEAST_COUNT = 0.1
# Least measurements of a static point, and their least share of its direction.
_MIN_COUNT, _MIN_SHARE = 8, 0.3
# Distance to the next measured cell within which a direction is in the field of view: 1.2°, more than half of the
# distance of rings of all but 8-ring LiDARs.
_FILLED_CELLS = 3
# Sweeps of a period, 5 s at 10 Hz, whose mean ranges are compared with those of others.
_PERIOD = 50
# Longest time between two sweeps within a coverage interval, s: in a longer one a person may cross the view.
_MAX_GAP = 0.5


@dataclass(frozen=True, eq=False)
class MovingPoints:
    """Points that are nearer than what stands still, by ascending sweep."""

    points: Array
    """(P, 3) sensor frame, m."""
    times: Array
    """(P,) s, by the sensor's clock."""
    sweep: Index
    """(P,) index of the sweep."""
    duration: float
    """Of a sweep, s; 0 where points have no times."""


@dataclass(frozen=True, eq=False)
class StaticView:
    """The static ranges of a sensor in all directions."""

    ranges: Array
    """(elevations, azimuths) m: inf where nothing stands still, NaN outside of the field of view."""

    def look_up(self, directions: Array) -> Array:
        """The static ranges (N,) in directions (N, 3) of any length, m; NaN outside of the field of view."""
        cell = _find_cells(directions, np.linalg.norm(directions, axis=1))
        return np.asarray(self.ranges.ravel()[cell])


@dataclass(frozen=True, eq=False)
class SplitClouds:
    """What stands still and what moves in the clouds of a sensor."""

    static: StaticPoints
    moving: MovingPoints
    view: StaticView
    coverage: Array
    """(W, 2) begin and end of the intervals in which it measured, s."""
    step: StaticStep | None
    """When the sensor moved, if it did."""
    untimed_sweep: float
    """As of :class:`SpaceObservations`."""


def find_rows(points: Array) -> Index:
    """(N,) number of the row of elevation, 0.4° high, of points (N, 3): different for different rings."""
    return np.asarray(_find_cells(points, np.linalg.norm(points, axis=1)) // _AZIMUTHS, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Part:
    """Points of some sweeps, in single precision."""

    points: NDArray[np.float32]
    times: NDArray[np.float32]
    """After the stamp of the sweep, s."""
    sweep: NDArray[np.int32]
    slot: NDArray[np.int32]
    """Of the direction."""
    bin: NDArray[np.int32]
    """Of the range."""


class CloudSplitter:
    """Splits clouds, added in any order, in static and moving points; holds few of them at a time."""

    def __init__(self) -> None:
        self._slot = np.full(_AZIMUTHS * _ELEVATIONS, -1, dtype=np.int32)
        self._cells = np.zeros(0, dtype=np.int64)
        self._histogram = np.zeros((0, _BINS), dtype=np.int32)
        self._mode = np.zeros(0, dtype=np.int32)
        self._sums = np.zeros((0, 6))
        self._by_period = np.zeros((0, 0, 2))
        self._held: list[_Part] = []
        self._candidates: list[_Part] = []
        self._spans: list[tuple[float, float, float]] = []

    def add(self, cloud: PointCloud) -> None:
        """Adds a sweep."""
        points = cloud.points.astype(np.float32)
        ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
        used = (ranges > _MIN_RANGE) & (ranges < _MAX_RANGE)
        if not used.any():
            return
        points, ranges = points[used], ranges[used]
        times = np.zeros(len(points), np.float32) if cloud.times is None else cloud.times[used].astype(np.float32)
        cell = _find_cells(points, ranges)
        slot = self._slot[cell]
        if (slot < 0).any():
            new = np.unique(cell[slot < 0])
            self._slot[new] = np.arange(len(self._cells), len(self._cells) + len(new))
            self._cells = np.append(self._cells, new)
            slot = self._slot[cell]
        bin_ = _to_bins(ranges)
        sweep = np.full(len(points), len(self._spans), dtype=np.int32)
        self._held.append(_Part(points, times, sweep, slot, bin_))
        self._spans.append((cloud.stamp, float(times.min()), float(times.max())))
        if sum(len(part.slot) for part in self._held) > _HELD_POINTS:
            self._split_held()

    def finish(self) -> SplitClouds | None:
        """What was added; None where no cloud had points."""
        if not self._spans:
            return None
        self._split_held()
        moving = join_rows(self._candidates)
        moving = select_rows(moving, _find_moving(self._histogram, _STATIC_SHARE)[moving.slot, moving.bin])
        stamps, first, last = np.array(self._spans).T
        order = np.lexsort((moving.times, stamps[moving.sweep]))
        rank = np.empty(len(stamps), dtype=np.intp)
        rank[np.argsort(stamps, kind="stable")] = np.arange(len(stamps))
        static, of_slot, enough = self._average()
        duration = float(np.median(last - first))
        period = float(np.median(np.diff(np.sort(stamps)))) if len(stamps) > 1 else 0.0
        count, total = np.moveaxis(self._by_period[:, enough], -1, 0)
        return SplitClouds(
            static,
            MovingPoints(
                moving.points[order].astype(np.float64),
                (stamps[moving.sweep] + moving.times)[order],
                rank[moving.sweep[order]],
                duration,
            ),
            _fill_view(self._cells, of_slot),
            _find_coverage(np.sort(stamps + first), np.sort(stamps + last)),
            find_step(static, count, total, stamps[::_PERIOD]),
            # LiDARs that flash have none either: their stamps may be of the time before a flash, or after it.
            0.0 if duration > 0 else period,
        )

    def _split_held(self) -> None:
        """Counts and averages the points that are held, and keeps those that may move."""
        if not self._held:
            return
        part = join_rows(self._held)
        self._held = []
        slots = len(self._cells)
        grown = slots - len(self._mode)
        counted = select_rows(part, part.sweep % _COUNTED == 0)
        flat = counted.slot.astype(np.int64) * _BINS + counted.bin
        counts = np.bincount(flat, minlength=slots * _BINS).reshape(slots, _BINS)
        self._histogram = np.pad(self._histogram, ((0, grown), (0, 0))) + counts.astype(np.int32)
        self._sums = np.pad(self._sums, ((0, grown), (0, 0)))
        mode = np.argmax(_smooth(self._histogram), axis=1).astype(np.int32)
        changed = np.abs(mode - np.pad(self._mode, (0, grown))) > 1
        self._mode = np.where(changed, mode, np.pad(self._mode, (0, grown)))
        self._sums[changed] = 0
        near = select_rows(counted, np.abs(counted.bin - self._mode[counted.slot]) <= 1)
        square = np.einsum("ij,ij->i", near.points, near.points, dtype=np.float64)
        for k, value in enumerate((None, *near.points.T, np.sqrt(square), square)):
            self._sums[:, k] += np.bincount(near.slot, value, minlength=slots)
        periods = len(self._spans) // _PERIOD + 1
        before = self._by_period.shape
        self._by_period = np.pad(self._by_period, ((0, periods - before[0]), (0, slots - before[1]), (0, 0)))
        self._by_period[:, changed] = 0
        cell = near.sweep.astype(np.int64) // _PERIOD * slots + near.slot
        for k, value in enumerate((None, np.sqrt(square))):
            counted_by = np.bincount(cell, value, minlength=periods * slots)
            self._by_period[..., k] += counted_by.reshape(periods, slots)
        moving = _find_moving(self._histogram, _SURE_SHARE)
        self._candidates.append(select_rows(part, moving[part.slot, part.bin]))

    def _average(self) -> tuple[StaticPoints, Array, NDArray[np.bool_]]:
        """Static points; of each slot (S,) the static range, m, inf where nothing stands still, and if it does."""
        count = self._sums[:, 0]
        enough = (count >= _MIN_COUNT) & (count >= _MIN_SHARE * self._histogram.sum(axis=1))
        n = count[enough, None]
        mean = self._sums[enough, 1:] / n
        variance = np.maximum(mean[:, 4] - mean[:, 3] ** 2, 0) * n[:, 0] / (n[:, 0] - 1)
        ranges = np.full(len(count), np.inf)
        ranges[enough] = mean[:, 3]
        static = StaticPoints(mean[:, :3], np.sqrt(variance), n[:, 0].astype(np.intp))
        return static, ranges, enough


def _find_cells(points: Array | NDArray[np.float32], ranges: Array | NDArray[np.float32]) -> Index:
    """(N,) the cells of directions (N, 3) with these lengths (N,)."""
    scale = points.dtype.type(1 / _CELL)
    azimuth = (np.arctan2(points[:, 1], points[:, 0]) * scale + _AZIMUTHS // 2).astype(np.int32)
    sine = np.clip(points[:, 2] / ranges, -1, 1)
    elevation = (np.arcsin(sine) * scale + _ELEVATIONS // 2).astype(np.int32)
    cell = np.clip(elevation, 0, _ELEVATIONS - 1) * _AZIMUTHS + np.clip(azimuth, 0, _AZIMUTHS - 1)
    return np.asarray(cell)


def _to_bins(ranges: Array | NDArray[np.float32]) -> NDArray[np.int32]:
    """(N,) the bins of ranges, from 1."""
    scale, origin = ranges.dtype.type(_BIN_STRETCH), ranges.dtype.type(_BIN_ORIGIN)
    return np.asarray(np.log1p(ranges / origin) * scale, dtype=np.int32) + 1


def _smooth(histogram: NDArray[np.int32]) -> NDArray[np.int32]:
    """Sums over three bins, (S, B): surfaces at the edge of a bin, and those at an angle, fill several."""
    sums = histogram.copy()
    sums[:, 1:] += histogram[:, :-1]
    sums[:, :-1] += histogram[:, 1:]
    return sums


def _find_moving(histogram: NDArray[np.int32], share: float) -> NDArray[np.bool_]:
    """(S, B) the bins nearer than the farthest static one, and not static themselves."""
    count = histogram.sum(axis=1)
    usual = np.median(count[count > 0]) if count.any() else 0.0
    static = _smooth(histogram) >= np.maximum(share * np.maximum(count, _LEAST_COUNT * usual), 1)[:, None]
    beyond = ~np.logical_or.accumulate(static[:, ::-1], axis=1)[:, ::-1] & static.any(axis=1)[:, None]
    moving = ~(static | beyond)
    moving[:, : int(_to_bins(np.array([_MIN_MOVING]))[0]) + 1] = False
    return np.asarray(moving)


def _fill_view(cells: Index, ranges: Array) -> StaticView:
    """The ranges of measured cells, and of those between them."""
    flat = np.full(_ELEVATIONS * _AZIMUTHS, np.nan)
    flat[cells] = ranges
    image = flat.reshape(_ELEVATIONS, _AZIMUTHS)
    distance, nearest = distance_transform_edt(np.isnan(image), return_indices=True)
    return StaticView(np.where(distance <= _FILLED_CELLS, image[tuple(nearest)], np.nan))


def _find_coverage(begin: Array, end: Array) -> Array:
    """(W, 2) intervals of sweeps, given by ascending begins and ends (S,), s, without long gaps."""
    cut = np.flatnonzero(begin[1:] - end[:-1] > _MAX_GAP)
    return np.stack([begin[np.append(0, cut + 1)], end[np.append(cut, len(end) - 1)]], axis=1)

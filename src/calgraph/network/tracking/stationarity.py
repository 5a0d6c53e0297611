"""Whether a scanner stood still: intervals of time with a constant pose, from its static background.

Source: Andrews, "Tests for parameter instability and structural change with unknown change point", 1993;
Vostrikova, "Detecting disorder in multidimensional random processes", 1981, for several steps by binary
segmentation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from calgraph.config.settings import StationaritySettings
from calgraph.geometry import STDDEV_PER_MAD, Array, Index
from calgraph.network.tracking.background_registration import (
    AGREEMENT_SIGMAS,
    INITIAL_SCALE,
    ReferenceScan,
    match_surfaces,
    register_windows,
    to_points,
)
from calgraph.network.tracking.scan_stack import SCANS_PER_CALL, ScanRun
from calgraph.network.tracking.track import ScannerBump
from calgraph.sensors import align_ranges


@dataclass(frozen=True, eq=False)
class ScanWindows:
    """Median ranges of one scanner in consecutive windows of time."""

    angles: Array
    """(B,) of the beams, ascending, rad."""
    ranges: Array
    """(W, B) median ranges, m; infinite where most scans of the window measured nothing."""
    start: Array
    """(W,) stamp of the first scan of each window, s."""
    end: Array
    """(W,) stamp of the last one, s."""

    def __len__(self) -> int:
        return len(self.start)


class AlignedScans:
    """All scans of a scanner with common beams, read in parts to bound memory.

    Args:
        runs: at least one, with beams.
    """

    def __init__(self, runs: Sequence[ScanRun]) -> None:
        self._runs = runs
        self._first = np.cumsum([0, *map(len, runs)])
        self.angles = np.sort(max(runs, key=lambda run: len(run.angles)).angles)
        """(B,) of the beams, ascending, rad."""
        self.stamps = np.concatenate([run.stamps for run in runs])
        """(S,) of the scans, s."""

    def read(self, scans: Index) -> Array:
        """The ranges (N, B) of scans (N,), ascending; infinite where nothing was measured."""
        part = np.searchsorted(self._first, scans, side="right") - 1
        rows = [np.empty((0, len(self.angles)))]
        for k in np.unique(part):
            run = self._runs[k]
            ranges = run.read(scans[part == k] - self._first[k])
            rows.append(align_ranges(self.angles, run.angles, ranges))
        ranges = np.concatenate(rows)
        ranges[~np.isfinite(ranges)] = np.inf
        return ranges


# Length of a window, s, whose median ranges are registered: people pass a beam in less than half of it, and a
# bump is located to about as much.
WINDOW = 1.0
# Maximum number of scans whose median is taken in a window, evenly spaced: medians of more are no better than the
# systematic errors below.
_MAX_SCANS_PER_WINDOW = 9


def compute_window_medians(scans: AlignedScans) -> ScanWindows:
    """Medians over windows with equal numbers of scans; a shorter rest at the end belongs to no window."""
    period = float(np.median(np.diff(scans.stamps))) if len(scans.stamps) > 1 else WINDOW
    per_window = max(1, round(WINDOW / period))
    windows = len(scans.stamps) // per_window
    first = per_window * np.arange(windows)
    # The middle scans of equal parts of the window.
    used = min(per_window, _MAX_SCANS_PER_WINDOW)
    chosen = first[:, None] + ((np.arange(used) + 0.5) * per_window / used).astype(np.intp)
    step = max(1, SCANS_PER_CALL // used)
    medians = np.empty((windows, len(scans.angles)))
    for k in range(0, windows, step):
        part = chosen[k : k + step]
        ranges = scans.read(part.ravel()).reshape(*part.shape, -1)
        medians[k : k + step] = np.partition(ranges, used // 2, axis=1)[:, used // 2]
    return ScanWindows(scans.angles, medians, scans.stamps[first], scans.stamps[first + per_window - 1])


# Median of χ² with three degrees of freedom.
_MEDIAN_CHI2 = 2.366
# Windows whose median pose replaces that of the middle one: two disturbed windows in a row have no effect.
_FILTER_LENGTH = 5
# Most windows whose median is the background of an interval.
_MAX_COMPOSITE = 30
# Differences of ranges count up to this, m, where the time of a bump is searched.
_MAX_RANGE_DIFFERENCE = 0.1

# Places of windows that register to no reference.
_TOO_LITTLE_BACKGROUND, _NOWHERE = -2, -1


@dataclass(frozen=True)
class Stationarity:
    """When a scanner stood still."""

    bumps: tuple[ScannerBump, ...] = ()
    """In order of time."""
    rest_share: float = 1.0
    """Share of the time in which it stood still for long enough, 1 if that cannot be tested;"""
    tested: bool = False
    """whether there is enough background for that most of the time."""


@dataclass(frozen=True, eq=False)
class _Registration:
    """Windows with the poses of the scanner."""

    windows: ScanWindows
    noise: float
    """Standard deviation of the windows' ranges, m."""
    place: Index
    """(W,) number of the reference that the window registers to, or why there is none."""
    unrest: Array
    """(W,) median difference of the ranges from those of its neighbours, m; infinite without ranges."""
    poses: Array
    """(W, 3) in the frame of the reference."""
    information: Array
    """(W, 3, 3) for points with a standard deviation of 1 m."""


# Minimum number of successive windows with one pose: fewer are disturbances.
_MIN_WINDOWS = 3
# Maximum, m: the medians of a moving scanner differ by more from one window to the next.
_MAX_NOISE = 0.02
# A scanner that is at rest for a smaller share of the time is on a moving platform.
MIN_REST_SHARE = 0.5


def analyze_stationarity(runs: Sequence[ScanRun], settings: StationaritySettings) -> Stationarity:
    """Finds the times at which a scanner moved.

    Medians over windows are registered to each other, and steps of the poses are searched. A step of the scanner
    displaces its whole background, so that most points have to agree with it: those of moved furniture do not.
    """
    runs = [run for run in runs if len(run.angles)]
    if not runs:
        return Stationarity()
    scans = AlignedScans(runs)
    windows = compute_window_medians(scans)
    if len(windows) < 2 * _MIN_WINDOWS:
        return Stationarity()
    registration = _register(windows)
    pieces, bumps = _measure_bumps(scans, registration, _find_pieces(registration))
    placed = registration.place >= 0
    # Windows that register nowhere are those of a moving scanner only if all ranges change.
    moving = (registration.place == _NOWHERE) & (registration.unrest > _MAX_NOISE)
    testable = int(np.sum(placed | moving))
    if not testable:
        return Stationarity()
    duration = min(settings.min_duration, float(windows.end[-1] - windows.start[0]) / 2) - WINDOW
    at_rest = sum(len(piece) for piece in pieces if windows.end[piece[-1]] - windows.start[piece[0]] > duration)
    tested = bool(np.mean(placed | moving) >= MIN_REST_SHARE)
    bumps = _include_motion(windows, pieces, bumps, placed | moving)
    return Stationarity(tuple(bumps), min(1.0, at_rest / testable), tested)


# Data within this time of a bump are not used, s: a scanner that is knocked swings for some periods.
_SETTLING_TIME = 0.25


def select_interval(
    stamps: tuple[float, float], bumps: Sequence[ScannerBump], settings: StationaritySettings
) -> tuple[float, float]:
    """The stamps (s) between which a scanner is calibrated: after its last bump, if these data are long enough.

    Otherwise the longest interval between bumps. Without bumps all times.

    Args:
        stamps: of the first and the last scan, s.
        bumps: in order of time.
        settings: the shortest time that is long enough.
    """
    if not bumps:
        return -np.inf, np.inf
    starts = [stamps[0], *(bump.interval[1] + _SETTLING_TIME for bump in bumps)]
    ends = [*(bump.interval[0] - _SETTLING_TIME for bump in bumps), stamps[1]]
    if ends[-1] - starts[-1] >= min(settings.min_duration, (ends[-1] - starts[0]) / 2):
        return starts[-1], np.inf
    return max(zip(starts, ends, strict=True), key=lambda interval: interval[1] - interval[0])


# Minimum standard deviation of a median range, m: ranges are quantised to 1 to 10 mm.
_MIN_NOISE = 0.002
# Maximum number of places of one scanner that do not register to each other.
_MAX_REFERENCES = 6
# Minimum number of compared points for a pose: a wall of 1 m at 2 m and one degree. With less background it is
# not tested whether the scanner moved.
_MIN_POINTS = 25
# Minimum share of the compared points on surfaces of the reference; the rest may be furniture that was moved.
_MIN_AGREEMENT = 0.6


def _register(windows: ScanWindows) -> _Registration:
    """Registers all windows to a few references among them."""
    finite = (np.where(np.isfinite(row), row, np.nan) for row in windows.ranges)
    by_window = np.array([_median(np.abs(after - before)) for before, after in pairwise(finite)])
    noise = float(np.clip(_median(by_window) * STDDEV_PER_MAD / np.sqrt(2), _MIN_NOISE, _MAX_NOISE))
    # How much a window differs from its neighbours: a reference is one at rest.
    unrest = np.maximum(np.append(by_window, 0.0), np.insert(by_window, 0, 0.0))
    count = len(windows)
    place = np.full(count, _TOO_LITTLE_BACKGROUND, dtype=np.intp)
    poses, information = np.zeros((count, 3)), np.zeros((count, 3, 3))
    pending = np.arange(count)
    for number in range(_MAX_REFERENCES):
        longest = max(np.split(pending, np.flatnonzero(np.diff(pending) > 1) + 1), key=len)
        if len(longest) < _MIN_WINDOWS:
            break
        chosen = longest[np.argmin(unrest[longest])]
        reference = ReferenceScan(windows.angles, windows.ranges[chosen])
        found = register_windows(reference, windows.ranges[pending], noise)
        comparable = found.compared >= _MIN_POINTS
        agrees = comparable & (found.agreement >= _MIN_AGREEMENT)
        place[pending[comparable]] = _NOWHERE
        placed = pending[agrees]
        place[placed], poses[placed], information[placed] = number, found.poses[agrees], found.information[agrees]
        pending = pending[~agrees & (pending != chosen)]
    return _Registration(windows, noise, place, unrest, poses, information)


def _median(values: Array) -> float:
    """The median of the finite values; infinite without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.inf


def _find_pieces(registration: _Registration) -> list[Index]:
    """Windows of successive times with one pose each, in order of time."""
    label = np.full(len(registration.place), -1)
    for number in range(registration.place.max() + 1):
        members = np.flatnonzero(registration.place == number)
        if len(members) >= _MIN_WINDOWS:
            for piece in _split_at_steps(registration, members):
                label[piece] = label.max() + 1
    placed = np.flatnonzero(label >= 0)
    pieces: list[Index] = []
    for piece in np.split(placed, np.flatnonzero(np.diff(label[placed])) + 1):
        if len(piece) < _MIN_WINDOWS:
            continue
        if pieces and label[pieces[-1][0]] == label[piece[0]]:
            pieces[-1] = np.concatenate([pieces[-1], piece])
        else:
            pieces.append(piece)
    return pieces


# Maximum factor on the variances of poses for the scatter from window to window, which people who pass increase;
# a moving scanner has a larger one, which is not noise.
_MAX_INFLATION = 9.0


def _split_at_steps(registration: _Registration, members: Index) -> list[Index]:
    """Splits windows (N,) of one place wherever their poses have a significant step."""
    poses = registration.poses[members]
    covariance = registration.noise**2 * np.linalg.inv(registration.information[members])
    step = np.diff(poses, axis=0)
    squared = np.sum(step * np.linalg.solve(covariance[1:] + covariance[:-1], step[..., None])[..., 0], axis=1)
    inflation = float(np.clip(np.median(squared) / _MEDIAN_CHI2, 1, _MAX_INFLATION))
    weight = np.linalg.inv(inflation * covariance)
    weighted = (weight @ median_filter(poses, (_FILTER_LENGTH, 1), mode="nearest")[..., None])[..., 0]
    systematic = _systematic_covariance(np.median(registration.information[members], axis=0))
    threshold = _significance_limit(registration)
    pieces: list[Index] = []
    stack = [np.arange(len(members))]
    while stack:
        part = stack.pop()
        cut = _find_largest_step(weight[part], weighted[part], 2 * systematic, threshold)
        if cut is None:
            # The filter hides the end of a motion.
            off = poses[part] - np.median(poses[part], axis=0)
            total = inflation * covariance[part] + systematic
            near = np.sum(off * np.linalg.solve(total, off[..., None])[..., 0], axis=1) <= threshold
            if near.any():
                first, last = np.flatnonzero(near)[[0, -1]]
                pieces.append(members[part[first : last + 1]])
        else:
            stack += [part[cut:], part[:cut]]
    return pieces


# Bound on the probability with which a scanner at rest has a step reported, for all times together (Bonferroni):
# one in a thousand recordings of ten scanners.
_FALSE_ALARM_PROBABILITY = 1e-4


def _significance_limit(registration: _Registration) -> float:
    """Squared Mahalanobis distance beyond which a step is significant."""
    return float(chdtri(3, _FALSE_ALARM_PROBABILITY / len(registration.place)))


def _find_largest_step(weight: Array, weighted: Array, systematic: Array, threshold: float) -> int | None:
    """The index after which the mean pose has changed most significantly; None if it has not."""
    cuts = np.arange(_MIN_WINDOWS, len(weight) - _MIN_WINDOWS + 1)
    if not len(cuts):
        return None
    W, Wy = np.cumsum(weight, axis=0), np.cumsum(weighted, axis=0)
    before, after = np.linalg.inv(W[cuts - 1]), np.linalg.inv(W[-1] - W[cuts - 1] + 1e-9 * W[-1])
    step = (after @ (Wy[-1] - Wy[cuts - 1])[..., None] - before @ Wy[cuts - 1][..., None])[..., 0]
    squared = np.sum(step * np.linalg.solve(before + after + systematic, step[..., None])[..., 0], axis=1)
    best = int(np.argmax(squared))
    return int(cuts[best]) if squared[best] > threshold else None


# Standard deviation of a pose by systematic errors, m, with any background: steps below 7 mm are not found.
_TRANSLATION_ERROR = 5e-4
# The same of its angle, rad (0.03°): steps below 0.2° are not found.
_ROTATION_ERROR = 3.5e-4
# Standard deviation of errors of a surface that vary slowly, m: warming up, reflectance, doors ajar, people who
# lean on walls.
_SURFACE_ERROR = 0.002
# Number of neighbouring points with this error in common.
_CORRELATED_POINTS = 10.0


def _systematic_covariance(information: Array) -> Array:
    """Covariance (3, 3) of a pose by errors of the surfaces that no average reduces."""
    floor = np.diag(np.square([_TRANSLATION_ERROR] * 2 + [_ROTATION_ERROR]))
    of_points = _SURFACE_ERROR**2 * _CORRELATED_POINTS
    return np.asarray(of_points * np.linalg.inv(information) + floor)


def _include_motion(
    windows: ScanWindows, pieces: Sequence[Index], bumps: Sequence[ScannerBump], testable: NDArray[np.bool_]
) -> list[ScannerBump]:
    """The bumps with those of unknown size before the first and after the last piece, where the scanner moves."""
    included = list(bumps)
    if pieces and testable[: pieces[0][0]].sum() >= _MIN_WINDOWS:
        interval = float(windows.start[0]), float(windows.start[pieces[0][0]])
        included.insert(0, ScannerBump(interval, np.nan, np.nan, 0.0, 0.0))
    if pieces and testable[pieces[-1][-1] + 1 :].sum() >= _MIN_WINDOWS:
        interval = float(windows.end[pieces[-1][-1]]), float(windows.end[-1])
        included.append(ScannerBump(interval, np.nan, np.nan, 0.0, 0.0))
    return included


def _measure_bumps(
    scans: AlignedScans, registration: _Registration, pieces: Sequence[Index]
) -> tuple[list[Index], list[ScannerBump]]:
    """The bumps between successive pieces, and these; joined where there is none."""
    kept, bumps = list(pieces[:1]), list[ScannerBump]()
    for piece in pieces[1:]:
        before, after = (_median_of_windows(registration.windows.ranges[one]) for one in (kept[-1], piece))
        bump = _measure_bump(registration, before, after)
        if bump is None:
            kept[-1] = np.concatenate([kept[-1], piece])
            continue
        interval = _locate(scans, registration.windows, kept[-1], piece, (before, after))
        kept.append(piece)
        bumps.append(ScannerBump(interval, *bump))
    return kept, bumps


# Standard deviation of a step's translation above which its direction is not observable, m, as along a single
# wall; the size of the step is that in the other direction.
_MAX_TRANSLATION_STDDEV = 0.05
# Where no pose explains how the ranges change, the surroundings have changed and not the scanner's place if this
# share of the ranges is the same.
_MAX_UNCHANGED = 0.3


def _measure_bump(
    registration: _Registration, before: Array, after: Array
) -> tuple[float, float, float, float] | None:
    """Translation, rotation and their standard deviations between median ranges (B,) before and after a bump.

    NaN if they have too little in common. None if the scanner did not move: something hides the background, or
    less than most of it is displaced.
    """
    reference = ReferenceScan(registration.windows.angles, before)
    found = register_windows(reference, after[None], registration.noise)
    pose = found.poses[0]
    if found.compared[0] >= _MIN_POINTS and found.agreement[0] >= _MIN_AGREEMENT:
        if not _is_majority_displaced(reference, after, pose, registration.noise):
            return None
        covariance = 2 * _systematic_covariance(found.information[0])
        # The medians of all windows are less disturbed by people than the poses of single ones.
        if pose @ np.linalg.solve(covariance, pose) <= _significance_limit(registration):
            return None
        variances, directions = np.linalg.eigh(covariance[:2, :2])
        # Along a wall the displacement is not observable.
        components = np.where(variances < _MAX_TRANSLATION_STDDEV**2, directions.T @ pose[:2], 0.0)
        stddev = np.sqrt([variances[-1], covariance[2, 2]])
        return float(np.hypot(*components)), float(pose[2]), float(stddev[0]), float(stddev[1])
    both = np.isfinite(before) & np.isfinite(after)
    unchanged = np.abs(after[both] - before[both]) < AGREEMENT_SIGMAS * registration.noise
    # A scanner that is displaced by far measures longer ranges in some directions, and shorter ones in others.
    margin = INITIAL_SCALE
    longer, shorter = int((after > before + margin).sum()), int((before > after + margin).sum())
    share = unchanged.sum() / max(int(np.isfinite(before).sum()), 1)
    if share >= _MAX_UNCHANGED or min(longer, shorter) < _MIN_POINTS:
        return None
    return np.nan, np.nan, 0.0, 0.0


def _median_of_windows(ranges: Array) -> Array:
    """(B,) medians of windows (W, B)."""
    chosen = ranges[:: -(-len(ranges) // _MAX_COMPOSITE)]
    return np.asarray(np.partition(chosen, len(chosen) // 2, axis=0)[len(chosen) // 2])


# Points that a step moves by at least this from their surfaces, m, vote on it: three standard deviations of a
# median over ten windows.
_INFORMATIVE_STEP = 0.003


def _is_majority_displaced(reference: ReferenceScan, ranges: Array, pose: Array, noise: float) -> bool:
    """Whether most points that distinguish a step from no step agree better with the step."""
    points, poses = to_points(reference.angles, ranges)[None], np.array([np.zeros(3), pose])
    distances = match_surfaces(
        reference, np.broadcast_to(points, (2, *points.shape[1:])), poses, INITIAL_SCALE
    ).distance
    # A point that meets no surface without the displacement is as far from it as can be.
    at_rest, displaced = np.nan_to_num(np.abs(distances[0]), nan=np.inf), np.abs(distances[1])
    compared = displaced < 3 * AGREEMENT_SIGMAS * noise
    compared |= at_rest < 3 * AGREEMENT_SIGMAS * noise
    differ = compared & ~(np.abs(at_rest - displaced) < _INFORMATIVE_STEP)
    votes = differ & (displaced < at_rest)
    count = int(differ.sum())
    return count >= _MIN_POINTS and bool(votes.sum() >= _MIN_AGREEMENT * count)


def _locate(
    scans: AlignedScans, windows: ScanWindows, before: Index, after: Index, ranges: Sequence[Array]
) -> tuple[float, float]:
    """Stamps (s) between which the ranges change from those before to those after."""
    first, last = windows.start[before[-1]], windows.end[after[0]]
    if after[0] - before[-1] > _FILTER_LENGTH:
        return float(windows.end[before[-1]]), float(windows.start[after[0]])
    between = np.flatnonzero((scans.stamps >= first) & (scans.stamps <= last))
    measured = scans.read(between)
    both = np.isfinite(ranges[0]) & np.isfinite(ranges[1])
    misfit = [
        np.minimum(np.abs(measured[:, both] - one[both]), _MAX_RANGE_DIFFERENCE).mean(axis=1) for one in ranges
    ]
    # The total misfit of a change before scan k is smallest at the bump.
    total = np.cumsum(np.append(0.0, misfit[0])) + np.cumsum(np.append(0.0, misfit[1])[::-1])[::-1]
    k = int(np.clip(np.argmin(total), 1, len(between) - 1))
    return float(scans.stamps[between[k - 1]]), float(scans.stamps[between[k]])

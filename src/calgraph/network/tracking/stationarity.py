"""Whether a scanner stood still: intervals of time with a constant pose, from its static background.

Source: Andrews, "Tests for parameter instability and structural change with unknown change point", 1993;
Vostrikova, "Detecting disorder in multidimensional random processes", 1981, for several steps by binary
segmentation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from calgraph.config.settings import StationaritySettings
from calgraph.geometry import Array, Index
from calgraph.network.tracking.background_registration import (
    ReferenceScan,
    match_surfaces,
    register_windows,
    to_points,
)
from calgraph.network.tracking.scan_stack import ScanRun
from calgraph.network.tracking.scan_windows import AlignedScans, ScanWindows, compute_window_medians
from calgraph.network.tracking.track import ScannerBump

# Median of χ² with three degrees of freedom, and standard deviation over median absolute deviation (normal).
_MEDIAN_CHI2, _STDDEV_PER_MAD = 2.366, 1.4826
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


def analyze_stationarity(runs: Sequence[ScanRun], settings: StationaritySettings) -> Stationarity:
    """Finds the times at which a scanner moved.

    Medians over windows are registered to each other, and steps of the poses are searched. A step of the scanner
    displaces its whole background, so that most points have to agree with it: those of moved furniture do not.
    """
    runs = [run for run in runs if run.ranges.size]
    if not runs:
        return Stationarity()
    scans = AlignedScans(runs)
    windows = compute_window_medians(scans, settings)
    if len(windows) < 2 * settings.min_windows:
        return Stationarity()
    registration = _register(windows, settings)
    pieces, bumps = _measure_bumps(scans, registration, _find_pieces(registration, settings), settings)
    placed = registration.place >= 0
    # Windows that register nowhere are those of a moving scanner only if all ranges change.
    moving = (registration.place == _NOWHERE) & (registration.unrest > settings.max_noise)
    testable = int(np.sum(placed | moving))
    if not testable:
        return Stationarity()
    duration = min(settings.min_duration, float(windows.end[-1] - windows.start[0]) / 2) - settings.window
    at_rest = sum(len(piece) for piece in pieces if windows.end[piece[-1]] - windows.start[piece[0]] > duration)
    tested = bool(np.mean(placed | moving) >= settings.min_rest_share)
    bumps = _include_motion(windows, pieces, bumps, placed | moving, settings)
    return Stationarity(tuple(bumps), min(1.0, at_rest / testable), tested)


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
    starts = [stamps[0], *(bump.interval[1] + settings.settling_time for bump in bumps)]
    ends = [*(bump.interval[0] - settings.settling_time for bump in bumps), stamps[1]]
    if ends[-1] - starts[-1] >= min(settings.min_duration, (ends[-1] - starts[0]) / 2):
        return starts[-1], np.inf
    return max(zip(starts, ends, strict=True), key=lambda interval: interval[1] - interval[0])


def _register(windows: ScanWindows, settings: StationaritySettings) -> _Registration:
    """Registers all windows to a few references among them."""
    finite = np.where(np.isfinite(windows.ranges), windows.ranges, np.nan)
    change = np.abs(np.diff(finite, axis=0))
    by_window = np.array([_median(row) for row in change])
    noise = float(
        np.clip(_median(by_window) * _STDDEV_PER_MAD / np.sqrt(2), settings.min_noise, settings.max_noise)
    )
    # How much a window differs from its neighbours: a reference is one at rest.
    unrest = np.maximum(np.append(by_window, 0.0), np.insert(by_window, 0, 0.0))
    count = len(windows)
    place = np.full(count, _TOO_LITTLE_BACKGROUND, dtype=np.intp)
    poses, information = np.zeros((count, 3)), np.zeros((count, 3, 3))
    pending = np.arange(count)
    for number in range(settings.max_references):
        longest = max(np.split(pending, np.flatnonzero(np.diff(pending) > 1) + 1), key=len)
        if len(longest) < settings.min_windows:
            break
        chosen = longest[np.argmin(unrest[longest])]
        reference = ReferenceScan(windows.angles, windows.ranges[chosen], settings)
        found = register_windows(reference, windows.ranges[pending], noise)
        comparable = found.compared >= settings.min_points
        agrees = comparable & (found.agreement >= settings.min_agreement)
        place[pending[comparable]] = _NOWHERE
        placed = pending[agrees]
        place[placed], poses[placed], information[placed] = number, found.poses[agrees], found.information[agrees]
        pending = pending[~agrees & (pending != chosen)]
    return _Registration(windows, noise, place, unrest, poses, information)


def _median(values: Array) -> float:
    """The median of the finite values; infinite without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.inf


def _find_pieces(registration: _Registration, settings: StationaritySettings) -> list[Index]:
    """Windows of successive times with one pose each, in order of time."""
    label = np.full(len(registration.place), -1)
    for number in range(registration.place.max() + 1):
        members = np.flatnonzero(registration.place == number)
        if len(members) >= settings.min_windows:
            for piece in _split_at_steps(registration, members, settings):
                label[piece] = label.max() + 1
    placed = np.flatnonzero(label >= 0)
    pieces: list[Index] = []
    for piece in np.split(placed, np.flatnonzero(np.diff(label[placed])) + 1):
        if len(piece) < settings.min_windows:
            continue
        if pieces and label[pieces[-1][0]] == label[piece[0]]:
            pieces[-1] = np.concatenate([pieces[-1], piece])
        else:
            pieces.append(piece)
    return pieces


def _split_at_steps(registration: _Registration, members: Index, settings: StationaritySettings) -> list[Index]:
    """Splits windows (N,) of one place wherever their poses have a significant step."""
    poses = registration.poses[members]
    covariance = registration.noise**2 * np.linalg.inv(registration.information[members])
    step = np.diff(poses, axis=0)
    squared = np.sum(step * np.linalg.solve(covariance[1:] + covariance[:-1], step[..., None])[..., 0], axis=1)
    inflation = float(np.clip(np.median(squared) / _MEDIAN_CHI2, 1, settings.max_inflation))
    weight = np.linalg.inv(inflation * covariance)
    weighted = (weight @ median_filter(poses, (_FILTER_LENGTH, 1), mode="nearest")[..., None])[..., 0]
    systematic = _systematic_covariance(np.median(registration.information[members], axis=0), settings)
    threshold = _significance_limit(registration, settings)
    pieces: list[Index] = []
    stack = [np.arange(len(members))]
    while stack:
        part = stack.pop()
        cut = _find_largest_step(weight[part], weighted[part], 2 * systematic, threshold, settings.min_windows)
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


def _significance_limit(registration: _Registration, settings: StationaritySettings) -> float:
    """Squared Mahalanobis distance beyond which a step is significant."""
    return float(chdtri(3, settings.false_alarm_probability / len(registration.place)))


def _find_largest_step(
    weight: Array, weighted: Array, systematic: Array, threshold: float, min_windows: int
) -> int | None:
    """The index after which the mean pose has changed most significantly; None if it has not."""
    cuts = np.arange(min_windows, len(weight) - min_windows + 1)
    if not len(cuts):
        return None
    W, Wy = np.cumsum(weight, axis=0), np.cumsum(weighted, axis=0)
    before, after = np.linalg.inv(W[cuts - 1]), np.linalg.inv(W[-1] - W[cuts - 1] + 1e-9 * W[-1])
    step = (after @ (Wy[-1] - Wy[cuts - 1])[..., None] - before @ Wy[cuts - 1][..., None])[..., 0]
    squared = np.sum(step * np.linalg.solve(before + after + systematic, step[..., None])[..., 0], axis=1)
    best = int(np.argmax(squared))
    return int(cuts[best]) if squared[best] > threshold else None


def _systematic_covariance(information: Array, settings: StationaritySettings) -> Array:
    """Covariance (3, 3) of a pose by errors of the surfaces that no average reduces."""
    floor = np.diag(np.square([settings.translation_error] * 2 + [settings.rotation_error]))
    of_points = settings.surface_error**2 * settings.correlated_points
    return np.asarray(of_points * np.linalg.inv(information) + floor)


def _include_motion(
    windows: ScanWindows,
    pieces: Sequence[Index],
    bumps: Sequence[ScannerBump],
    testable: NDArray[np.bool_],
    settings: StationaritySettings,
) -> list[ScannerBump]:
    """The bumps with those of unknown size before the first and after the last piece, where the scanner moves."""
    included = list(bumps)
    if pieces and testable[: pieces[0][0]].sum() >= settings.min_windows:
        interval = float(windows.start[0]), float(windows.start[pieces[0][0]])
        included.insert(0, ScannerBump(interval, np.nan, np.nan, 0.0, 0.0))
    if pieces and testable[pieces[-1][-1] + 1 :].sum() >= settings.min_windows:
        interval = float(windows.end[pieces[-1][-1]]), float(windows.end[-1])
        included.append(ScannerBump(interval, np.nan, np.nan, 0.0, 0.0))
    return included


def _measure_bumps(
    scans: AlignedScans, registration: _Registration, pieces: Sequence[Index], settings: StationaritySettings
) -> tuple[list[Index], list[ScannerBump]]:
    """The bumps between successive pieces, and these; joined where there is none."""
    kept, bumps = list(pieces[:1]), list[ScannerBump]()
    for piece in pieces[1:]:
        before, after = (_median_of_windows(registration.windows.ranges[one]) for one in (kept[-1], piece))
        bump = _measure_bump(registration, before, after, settings)
        if bump is None:
            kept[-1] = np.concatenate([kept[-1], piece])
            continue
        interval = _locate(scans, registration.windows, kept[-1], piece, (before, after))
        kept.append(piece)
        bumps.append(ScannerBump(interval, *bump))
    return kept, bumps


def _measure_bump(
    registration: _Registration, before: Array, after: Array, settings: StationaritySettings
) -> tuple[float, float, float, float] | None:
    """Translation, rotation and their standard deviations between median ranges (B,) before and after a bump.

    NaN if they have too little in common. None if the scanner did not move: something hides the background, or
    less than most of it is displaced.
    """
    reference = ReferenceScan(registration.windows.angles, before, settings)
    found = register_windows(reference, after[None], registration.noise)
    pose = found.poses[0]
    if found.compared[0] >= settings.min_points and found.agreement[0] >= settings.min_agreement:
        if not _is_majority_displaced(reference, after, pose, registration.noise, settings):
            return None
        covariance = 2 * _systematic_covariance(found.information[0], settings)
        # The medians of all windows are less disturbed by people than the poses of single ones.
        if pose @ np.linalg.solve(covariance, pose) <= _significance_limit(registration, settings):
            return None
        variances, directions = np.linalg.eigh(covariance[:2, :2])
        # Along a wall the displacement is not observable.
        components = np.where(variances < settings.max_translation_stddev**2, directions.T @ pose[:2], 0.0)
        stddev = np.sqrt([variances[-1], covariance[2, 2]])
        return float(np.hypot(*components)), float(pose[2]), float(stddev[0]), float(stddev[1])
    both = np.isfinite(before) & np.isfinite(after)
    unchanged = np.abs(after[both] - before[both]) < settings.agreement_sigmas * registration.noise
    # A scanner that is displaced by far measures longer ranges in some directions, and shorter ones in others.
    margin = settings.initial_scale
    longer, shorter = int((after > before + margin).sum()), int((before > after + margin).sum())
    share = unchanged.sum() / max(int(np.isfinite(before).sum()), 1)
    if share >= settings.max_unchanged or min(longer, shorter) < settings.min_points:
        return None
    return np.nan, np.nan, 0.0, 0.0


def _median_of_windows(ranges: Array) -> Array:
    """(B,) medians of windows (W, B)."""
    chosen = ranges[:: -(-len(ranges) // _MAX_COMPOSITE)]
    return np.asarray(np.partition(chosen, len(chosen) // 2, axis=0)[len(chosen) // 2])


def _is_majority_displaced(
    reference: ReferenceScan, ranges: Array, pose: Array, noise: float, settings: StationaritySettings
) -> bool:
    """Whether most points that distinguish a step from no step agree better with the step."""
    points, poses = to_points(reference.angles, ranges)[None], np.array([np.zeros(3), pose])
    distances = match_surfaces(
        reference, np.broadcast_to(points, (2, *points.shape[1:])), poses, settings.initial_scale
    ).distance
    # A point that meets no surface without the displacement is as far from it as can be.
    at_rest, displaced = np.nan_to_num(np.abs(distances[0]), nan=np.inf), np.abs(distances[1])
    compared = displaced < 3 * settings.agreement_sigmas * noise
    compared |= at_rest < 3 * settings.agreement_sigmas * noise
    differ = compared & ~(np.abs(at_rest - displaced) < settings.informative_step)
    votes = differ & (displaced < at_rest)
    count = int(differ.sum())
    return count >= settings.min_points and bool(votes.sum() >= settings.min_agreement * count)


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

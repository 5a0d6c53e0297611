"""Bumps of scanners with too little static background: steps of a pose with respect to tracks of other scanners.

Positions that a scanner measures are registered robustly to simultaneous positions of other scanners, separately
before and after a time.

Source: Andrews, "Tests for parameter instability and structural change with unknown change point", 1993; White, "A
heteroskedasticity-consistent covariance matrix estimator", 1980, for residuals that depend within blocks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.special import fdtri

from calgraph.geometry import Array, Index, se2, select_rows
from calgraph.network.pairs.synchronized_tracks import TICK_PERIOD, TrackSamples, pair_samples, resample_tracks
from calgraph.network.tracking.track import ScannerBump, ScannerTracks, correct_tracks

# Limit on steps, of which the scale takes about ten to shrink; largest component of the last one, m or rad.
_MAX_STEPS, _STEP_TOLERANCE = 30, 1e-4
# Information on a step, 1/m² and 1/rad²: keeps directions invertible that no position measures.
_STEP_PRIOR_INFORMATION = 1e-6


@dataclass(frozen=True, eq=False)
class _Matches:
    """Positions of a scanner with all simultaneous ones of other scanners: M, ordered by group.

    A group is of one position of the scanner and one other scanner, whose nearest position counts.
    """

    x: Array
    """(M, 2) in the scanner's frame, m."""
    y: Array
    """(M, 2) of the other scanner, in the root frame, m."""
    tick: Index
    """(M,) ascending: times of the groups are, too."""
    group: Index
    """(M,) ascending."""

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def first(self) -> Index:
        """(G,) index of the first row of each group."""
        return np.flatnonzero(np.diff(self.group, prepend=-1))

    def squared_distances(self, T_root_scanner: Array) -> Array:
        """(M,) m²."""
        return np.asarray(np.sum((self.y - se2.apply(T_root_scanner, self.x)) ** 2, axis=1))

    def nearest(self, T_root_scanner: Array) -> Array:
        """(G,) distance of the nearest position in each group, m."""
        return np.asarray(np.sqrt(np.minimum.reduceat(self.squared_distances(T_root_scanner), self.first)))


@dataclass(frozen=True, eq=False)
class _Fit:
    """The pose of a scanner in some time."""

    T_root_scanner: Array
    covariance: Array
    """(3, 3) in the root's fixed axes; residuals within blocks of time may depend on each other in any way."""
    blocks: int
    """Of time, with positions."""


@dataclass(frozen=True, eq=False)
class _Step:
    """A step between two ticks."""

    ticks: tuple[int, int]
    difference: Array
    """(3,) in the root's fixed axes."""
    covariance: Array
    significance: float
    """Squared Mahalanobis distance over its limit."""


def find_track_bump(
    tracked: Mapping[str, ScannerTracks], names: Sequence[str], T_root_scanner: Array, clock_offset: Array
) -> tuple[str, ScannerBump] | None:
    """The most significant step among the scanners that too little background was measured of to test them.

    The size of the step is significant at a false alarm rate for all scanners and times together (Bonferroni), and
    most positions that distinguish both poses agree with it on either side: those of people who are confused with
    others do not.

    Args:
        tracked: by scanner.
        names: of the connected scanners.
        T_root_scanner: (N, 3, 3) poses of these.
        clock_offset: (N,) of these to the root's clock, s.

    Returns:
        The scanner and its bump, with stamps of the clock of its tracks; None if there is none.
    """
    tested = [k for k, name in enumerate(names) if not (tracked[name].background_tested or tracked[name].bumps)]
    if not tested:
        return None
    samples = [
        resample_tracks(correct_tracks(tracked[name], clock_offset=float(offset)))
        for name, offset in zip(names, clock_offset, strict=True)
    ]
    matches = [_match_positions(samples, T_root_scanner, k) for k in tested]
    steps = [_find_step(one, T_root_scanner[k], len(tested)) for k, one in zip(tested, matches, strict=True)]
    found = [(step.significance, k, step) for k, step in zip(tested, steps, strict=True) if step]
    if not found:
        return None
    _, k, step = max(found, key=lambda one: one[0])
    begin, end = (tick * TICK_PERIOD + float(clock_offset[k]) for tick in step.ticks)
    stddev = np.sqrt([np.linalg.eigvalsh(step.covariance[:2, :2])[-1], step.covariance[2, 2]])
    translation = float(np.hypot(*step.difference[:2]))
    return names[k], ScannerBump(
        (begin, end), translation, float(step.difference[2]), float(stddev[0]), float(stddev[1])
    )


def _match_positions(samples: Sequence[TrackSamples], T_root_scanner: Array, k: int) -> _Matches:
    """All simultaneous positions of scanner k and the others."""
    x, y, tick, group = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for j, other in enumerate(samples):
        if j != k and len(other.tick) and len(samples[k].tick):
            pairs = pair_samples(samples[k], other)
            x.append(pairs.x_a)
            y.append(se2.apply(T_root_scanner[j], pairs.x_b))
            tick.append(samples[k].tick[pairs.row_a])
            group.append(pairs.row_a * len(samples) + j)
    found = _Matches(np.concatenate(x), np.concatenate(y), np.concatenate(tick), np.concatenate(group))
    return select_rows(found, np.argsort(found.group, kind="stable"))


# Ticks (TICK_PERIOD of pairs) within which errors of positions may depend on each other: 2 s, in which people
# turn by less than a right angle to a scanner and one side of them is measured.
_BLOCK_TICKS = 20
# Minimum number of such blocks with common positions on either side of a step: the three components of a pose
# leave two for its variance.
_MIN_BLOCKS = 5
# Distance of simultaneous positions at which the loss has a quarter of its weight in the first step, m: a scanner
# turned by 10° displaces people at 15 m by 2.6 m.
_INITIAL_SCALE = 3.0


def _find_step(matches: _Matches, T_root_scanner: Array, scanners: int) -> _Step | None:
    """The most significant step of one scanner, started from poses in thirds of its time."""
    ticks = np.unique(matches.tick)
    if len(np.unique(ticks // _BLOCK_TICKS)) < 2 * _MIN_BLOCKS:
        return None
    thirds = np.searchsorted([ticks[len(ticks) // 3], ticks[2 * len(ticks) // 3]], matches.tick, "right")
    parts = [select_rows(matches, thirds == part) for part in range(3)]
    starts = [_fit_pose(part, T_root_scanner, _INITIAL_SCALE) for part in parts]
    steps = [
        _refine_step(matches, before.T_root_scanner, after.T_root_scanner, scanners)
        for before, after in combinations(starts, 2)
    ]
    found = [step for step in steps if step]
    return max(found, key=lambda step: step.significance) if found else None


# Rounds of locating a step in time and fitting the poses before and after it: the first one starts from poses of
# thirds of the recording, of which one may contain the step, and the second from poses without it.
_ROUNDS = 2
# Distance of simultaneous positions of one person, m: more than their errors, less than people keep.
_MAX_DISTANCE = 0.3
# m; standard deviation of a step by errors of positions that depend on the paths: sides of people that are
# measured before and after it differ.
_TRANSLATION_ERROR = 0.01
# rad (0.1°); the same of its angle: a centimetre at 6 m.
_ROTATION_ERROR = 1.75e-3
# Bound on the probability with which a recording without bumps has one reported, for all scanners and times
# together (Bonferroni).
_FALSE_ALARM_PROBABILITY = 1e-3


def _refine_step(matches: _Matches, before: Array, after: Array, scanners: int) -> _Step | None:
    """The step between poses near two given ones, at the most likely time; None if it is not significant."""
    for _ in range(_ROUNDS):
        begin, end = _locate_step(matches, before, after)
        parts = select_rows(matches, matches.tick <= begin), select_rows(matches, matches.tick >= end)
        if not all(map(len, parts)):
            return None
        fits = [_fit_pose(part, T, _MAX_DISTANCE) for part, T in zip(parts, (before, after), strict=True)]
        before, after = (fit.T_root_scanner for fit in fits)
    if min(fit.blocks for fit in fits) < _MIN_BLOCKS:
        return None
    agree = _agree(parts[0], before, after) and _agree(parts[1], after, before)
    difference = se2.difference(after, before)
    floor = np.diag(np.square([_TRANSLATION_ERROR] * 2 + [_ROTATION_ERROR]))
    covariance = fits[0].covariance + fits[1].covariance + floor
    blocks = fits[0].blocks + fits[1].blocks
    limit = 3 * fdtri(3, blocks - 6, 1 - _FALSE_ALARM_PROBABILITY / (scanners * blocks))
    squared = float(difference @ np.linalg.solve(covariance, difference))
    return _Step((begin, end), difference, covariance, squared / limit) if agree and squared > limit else None


# Times whose sum of squared distances exceeds the least one by up to this, in squares of _FINAL_SCALE, are
# possible times of a step: twice the logarithm of 20 (95 %).
_MAX_EXCESS = 6.0
# The same in the last step, m: twice the errors of centres.
_FINAL_SCALE = 0.1


def _locate_step(matches: _Matches, before: Array, after: Array) -> tuple[int, int]:
    """The last tick before and the first one after a step between two poses, as far as positions show."""
    tick = matches.tick[matches.first]
    errors = [np.minimum(matches.nearest(T), _MAX_DISTANCE) ** 2 for T in (before, after)]
    total = np.cumsum(np.append(0.0, errors[0] - errors[1]))
    likely = np.flatnonzero(total < total.min() + _MAX_EXCESS * _FINAL_SCALE**2)
    return int(tick[max(likely[0] - 1, 0)]), int(tick[min(likely[-1], len(tick) - 1)])


# Positions distinguish two poses if their distances differ by this, m: half of the errors of centres.
_MIN_DIFFERENCE = 0.03
# Minimum number of such positions on either side of a step: 2 s of one person.
_MIN_VOTES = 20
# Minimum share of them that agree with the step on either side: in simulated rooms at least 0.89 with steps of 1°
# and 3°, and 0.77 at most where four people who walk as legs are mistaken for each other.
_MIN_VOTE_SHARE = 0.85


def _agree(matches: _Matches, pose: Array, other: Array) -> bool:
    """Whether most positions that distinguish two poses are nearer to those of other scanners under the first."""
    with_pose, with_other = matches.nearest(pose), matches.nearest(other)
    telling = np.minimum(with_pose, with_other) < _MAX_DISTANCE
    telling &= np.abs(with_pose - with_other) > _MIN_DIFFERENCE
    votes = (with_pose < with_other)[telling]
    return len(votes) >= _MIN_VOTES and bool(votes.mean() >= _MIN_VOTE_SHARE)


# Factor of this distance from one step to the next.
_SCALE_FACTOR = 0.7


def _fit_pose(matches: _Matches, T_root_scanner: Array, scale: float) -> _Fit:
    """The pose under which positions agree robustly, from an initial pose and scale, m."""
    T = T_root_scanner
    for _ in range(_MAX_STEPS):
        squared = matches.squared_distances(T)
        least = np.repeat(np.minimum.reduceat(squared, matches.first), np.diff(matches.first, append=len(matches)))
        chosen = squared == least
        p = se2.apply(T, matches.x[chosen])
        e, q, w = matches.y[chosen] - p, p - T[:2, 2], (1 + squared[chosen] / scale**2) ** -2
        J = np.zeros((len(e), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1
        J[:, 0, 2], J[:, 1, 2] = -q[:, 1], q[:, 0]
        information = np.einsum("n,nki,nkj->ij", w, J, J) + _STEP_PRIOR_INFORMATION * np.eye(3)
        gradient = np.einsum("n,nki,nk->ni", w, J, e)
        step = np.asarray(np.linalg.solve(information, gradient.sum(axis=0)))
        T = se2.retract(T, step)
        if scale <= _FINAL_SCALE and np.abs(step).max() < _STEP_TOLERANCE:
            break
        scale = max(_FINAL_SCALE, scale * _SCALE_FACTOR)
    blocks, block = np.unique(matches.tick[chosen] // _BLOCK_TICKS, return_inverse=True)
    of_blocks = np.zeros((len(blocks), 3))
    np.add.at(of_blocks, block, gradient)
    inverse = np.linalg.inv(information)
    inflation = len(blocks) / max(len(blocks) - 3, 1)
    return _Fit(T, np.asarray(inflation * inverse @ (of_blocks.T @ of_blocks) @ inverse), len(blocks))

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
from numpy.typing import NDArray
from scipy.special import fdtri

from calgraph.config.settings import ResamplingSettings, TrackBumpSettings
from calgraph.geometry import Array, Index, se2
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples, resample_tracks
from calgraph.network.tracking.corrected_tracks import correct_tracks
from calgraph.network.tracking.track import ScannerBump, ScannerTracks

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

    def select(self, rows: NDArray[np.bool_]) -> "_Matches":
        """Some of the rows (M,), of whole groups."""
        return _Matches(self.x[rows], self.y[rows], self.tick[rows], self.group[rows])

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
    tracked: Mapping[str, ScannerTracks],
    names: Sequence[str],
    T_root_scanner: Array,
    clock_offset: Array,
    settings: TrackBumpSettings,
    resampling_settings: ResamplingSettings,
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
        settings: of the test.
        resampling_settings: of tracks.

    Returns:
        The scanner and its bump, with stamps of the clock of its tracks; None if there is none.
    """
    tested = [k for k, name in enumerate(names) if not (tracked[name].background_tested or tracked[name].bumps)]
    if not tested:
        return None
    samples = [
        resample_tracks(correct_tracks(tracked[name], clock_offset=float(offset)), resampling_settings)
        for name, offset in zip(names, clock_offset, strict=True)
    ]
    matches = [_match_positions(samples, T_root_scanner, k) for k in tested]
    steps = [
        _find_step(one, T_root_scanner[k], len(tested), settings) for k, one in zip(tested, matches, strict=True)
    ]
    found = [(step.significance, k, step) for k, step in zip(tested, steps, strict=True) if step]
    if not found:
        return None
    _, k, step = max(found, key=lambda one: one[0])
    begin, end = (tick * resampling_settings.tick_period + float(clock_offset[k]) for tick in step.ticks)
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
    order = np.argsort(np.concatenate(group), kind="stable")
    return _Matches(
        np.concatenate(x)[order],
        np.concatenate(y)[order],
        np.concatenate(tick)[order],
        np.concatenate(group)[order],
    )


def _find_step(
    matches: _Matches, T_root_scanner: Array, scanners: int, settings: TrackBumpSettings
) -> _Step | None:
    """The most significant step of one scanner, started from poses in thirds of its time."""
    ticks = np.unique(matches.tick)
    if len(np.unique(ticks // settings.block_ticks)) < 2 * settings.min_blocks:
        return None
    thirds = np.searchsorted([ticks[len(ticks) // 3], ticks[2 * len(ticks) // 3]], matches.tick, "right")
    parts = [matches.select(thirds == part) for part in range(3)]
    starts = [_fit_pose(part, T_root_scanner, settings.initial_scale, settings) for part in parts]
    steps = [
        _refine_step(matches, before.T_root_scanner, after.T_root_scanner, scanners, settings)
        for before, after in combinations(starts, 2)
    ]
    found = [step for step in steps if step]
    return max(found, key=lambda step: step.significance) if found else None


def _refine_step(
    matches: _Matches, before: Array, after: Array, scanners: int, settings: TrackBumpSettings
) -> _Step | None:
    """The step between poses near two given ones, at the most likely time; None if it is not significant."""
    for _ in range(settings.rounds):
        begin, end = _locate_step(matches, before, after, settings)
        parts = matches.select(matches.tick <= begin), matches.select(matches.tick >= end)
        if not all(map(len, parts)):
            return None
        fits = [
            _fit_pose(part, T, settings.max_distance, settings)
            for part, T in zip(parts, (before, after), strict=True)
        ]
        before, after = (fit.T_root_scanner for fit in fits)
    if min(fit.blocks for fit in fits) < settings.min_blocks:
        return None
    agree = _agree(parts[0], before, after, settings) and _agree(parts[1], after, before, settings)
    difference = se2.difference(after, before)
    floor = np.diag(np.square([settings.translation_error] * 2 + [settings.rotation_error]))
    covariance = fits[0].covariance + fits[1].covariance + floor
    blocks = fits[0].blocks + fits[1].blocks
    limit = 3 * fdtri(3, blocks - 6, 1 - settings.false_alarm_probability / (scanners * blocks))
    squared = float(difference @ np.linalg.solve(covariance, difference))
    return _Step((begin, end), difference, covariance, squared / limit) if agree and squared > limit else None


def _locate_step(matches: _Matches, before: Array, after: Array, settings: TrackBumpSettings) -> tuple[int, int]:
    """The last tick before and the first one after a step between two poses, as far as positions show."""
    tick = matches.tick[matches.first]
    errors = [np.minimum(matches.nearest(T), settings.max_distance) ** 2 for T in (before, after)]
    total = np.cumsum(np.append(0.0, errors[0] - errors[1]))
    likely = np.flatnonzero(total < total.min() + settings.max_excess * settings.final_scale**2)
    return int(tick[max(likely[0] - 1, 0)]), int(tick[min(likely[-1], len(tick) - 1)])


def _agree(matches: _Matches, pose: Array, other: Array, settings: TrackBumpSettings) -> bool:
    """Whether most positions that distinguish two poses are nearer to those of other scanners under the first."""
    with_pose, with_other = matches.nearest(pose), matches.nearest(other)
    telling = np.minimum(with_pose, with_other) < settings.max_distance
    telling &= np.abs(with_pose - with_other) > settings.min_difference
    votes = (with_pose < with_other)[telling]
    return len(votes) >= settings.min_votes and bool(votes.mean() >= settings.min_vote_share)


def _fit_pose(matches: _Matches, T_root_scanner: Array, scale: float, settings: TrackBumpSettings) -> _Fit:
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
        if scale <= settings.final_scale and np.abs(step).max() < _STEP_TOLERANCE:
            break
        scale = max(settings.final_scale, scale * settings.scale_factor)
    blocks, block = np.unique(matches.tick[chosen] // settings.block_ticks, return_inverse=True)
    of_blocks = np.zeros((len(blocks), 3))
    np.add.at(of_blocks, block, gradient)
    inverse = np.linalg.inv(information)
    inflation = len(blocks) / max(len(blocks) - 3, 1)
    return _Fit(T, np.asarray(inflation * inverse @ (of_blocks.T @ of_blocks) @ inverse), len(blocks))

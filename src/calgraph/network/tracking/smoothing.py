"""Smoothing of many track segments in batches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import TrackingSettings
from calgraph.geometry import Array
from calgraph.network.tracking.association import GATE, INITIAL_SPEED_SIGMA
from calgraph.network.tracking.features import MeasuredCenters
from calgraph.network.tracking.filtering import smooth_tracks

# Segments smoothed in one batch; they are of similar length, so that padding stays small.
_BATCH = 64
# Median of χ² with two degrees of freedom.
CHI2_MEDIAN = 1.386
# Bisections: they resolve the variance to 2^-24 of its bracket.
_BISECTIONS = 24


@dataclass(frozen=True, eq=False)
class SmoothedSegment:
    """Smoothed states of one object at the times of the measurements that passed the gate."""

    members: NDArray[np.intp]
    """(T,) its clusters, in order of time."""
    mean: Array
    """(T, 4) x, y (m), vx, vy (m/s), sensor frame."""
    covariance: Array
    """(T, 4, 4)."""


def smooth_segments(
    segments: Sequence[NDArray[np.intp]], times: Array, measured: MeasuredCenters, settings: TrackingSettings
) -> tuple[SmoothedSegment, ...]:
    """Smooths each segment separately.

    Args:
        segments: the clusters of each.
        times: (C,) of the clusters, s.
        measured: (C,) their centres; missing ones, and those outside the gate, are left out.
        settings: of tracking.

    Returns:
        One for each segment, in their order; empty where nothing was measured.
    """
    valid = np.asarray(np.isfinite(measured.positions).all(axis=1))
    kept = [_sort_by_time(members[valid[members]], times) for members in segments]
    result = [SmoothedSegment(members, np.empty((0, 4)), np.empty((0, 4, 4))) for members in kept]
    by_length = [i for i in sorted(range(len(kept)), key=lambda i: len(kept[i])) if len(kept[i])]
    for low in range(0, len(by_length), _BATCH):
        batch = by_length[low : low + _BATCH]
        together = _smooth_batch([kept[i] for i in batch], times, measured, settings)
        for i, smoothed in zip(batch, together, strict=True):
            result[i] = smoothed
    return tuple(result)


# Minimum number of triples of centres for an estimate: its median is then uncertain by about 30 %.
_MIN_TRIPLES = 20
# Share of this variance that counts as bias: it is correlated over a step of the walk, longer than the smoother
# averages.
_BIAS_SHARE = 0.5


def add_unmodeled_noise(
    segments: Sequence[NDArray[np.intp]], times: Array, measured: MeasuredCenters, settings: TrackingSettings
) -> MeasuredCenters:
    """Adds the noise that the scatter of the centres about a smooth motion shows beyond the stated noise.

    The ellipse model does not fit a person of whom now one leg and now both are visible. Each centre is compared
    with the line between those 0.2 s before and after; the variance that noise and acceleration do not explain,
    in the median, is added to all. A part of it counts as bias: it is correlated over a step of the walk.
    """
    valid = np.asarray(np.isfinite(measured.positions).all(axis=1))
    kept = [_sort_by_time(members[valid[members]], times) for members in segments]
    triples = np.concatenate([_triples(members, times) for members in kept]) if kept else np.empty((0, 3), int)
    if len(triples) < _MIN_TRIPLES:
        return measured
    before, here, after = triples.T
    dt_before, dt_after = times[here] - times[before], times[after] - times[here]
    w = (dt_after / (dt_before + dt_after))[:, None]
    off = measured.positions[here] - w * measured.positions[before] - (1 - w) * measured.positions[after]
    share = w[..., None] ** 2
    V = measured.noise[here] + share * measured.noise[before] + (1 - w[..., None]) ** 2 * measured.noise[after]
    # The second difference of twice integrated white noise (Särkkä, section 6.2).
    V = V + (settings.acceleration_density * (dt_before * dt_after) ** 1.5 / 6)[:, None, None] * np.eye(2)
    # Three equal variances add to 1 + 1/4 + 1/4 of one in a second difference in the middle of two times.
    low, high = 0.0, float((off**2).sum(axis=1).max())
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(V + 1.5 * middle * np.eye(2)), off)
        low, high = (middle, high) if np.median(squared) > CHI2_MEDIAN else (low, middle)
    excess = low * np.eye(2)
    return MeasuredCenters(measured.positions, measured.noise + excess, measured.bias + _BIAS_SHARE * excess)


# Distance in time of the centres that are compared, s: shorter than half a step, over which a person accelerates
# little, and two or more scans.
_LAG = 0.2
# Minimum and maximum time of the earlier centre before the middle one, in lags: the earliest within it is taken.
# It holds a scan of every scanner with 7 Hz or more (0.15 s).
_EARLIER_WINDOW = (0.5, 1.25)
# Minimum and maximum time of the later centre after the middle one, in lags: the earliest within it is taken, so
# that with dense scans three centres span two lags.
_LATER_WINDOW = (0.75, 1.5)


def _triples(members: NDArray[np.intp], times: Array) -> NDArray[np.intp]:
    """(N, 3) triples of clusters: about a lag before, at, and about a lag after a time."""
    t, lag = times[members], _LAG
    (least_before, most_before), (least_after, most_after) = _EARLIER_WINDOW, _LATER_WINDOW
    before, after = np.searchsorted(t, t - most_before * lag), np.searchsorted(t, t + least_after * lag)
    inside = np.flatnonzero(after < len(t))
    i, j, k = before[inside], inside, after[inside]
    near = (t[j] - t[i] > least_before * lag) & (t[k] - t[j] < most_after * lag)
    return np.asarray(np.stack([members[i], members[j], members[k]], axis=1)[near])


def _sort_by_time(members: NDArray[np.intp], times: Array) -> NDArray[np.intp]:
    return members[np.argsort(times[members], kind="stable")]


def _smooth_batch(
    segments: Sequence[NDArray[np.intp]], times: Array, measured: MeasuredCenters, settings: TrackingSettings
) -> list[SmoothedSegment]:
    """Smooths segments padded to the longest; the padding repeats the last time without a measurement."""
    lengths = np.array([len(members) for members in segments])
    column = np.arange(lengths.max())
    index = np.stack([members[np.minimum(column, len(members) - 1)] for members in segments])
    z = np.where((column < lengths[:, None])[..., None], measured.positions[index], np.nan)
    state, used = smooth_tracks(
        times[index], z, measured.noise[index], settings.acceleration_density, GATE, INITIAL_SPEED_SIGMA
    )
    chosen = [np.flatnonzero(row) for row in used]
    return [
        SmoothedSegment(members[steps], state.mean[k, steps], state.covariance[k, steps])
        for k, (members, steps) in enumerate(zip(segments, chosen, strict=True))
    ]

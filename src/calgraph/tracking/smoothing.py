"""Smoothing many pieces of tracks side by side."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.tracking.association import GATE
from calgraph.tracking.features import Centres
from calgraph.tracking.filtering import smooth

# Pieces smoothed side by side; they are of like length, so that padding stays small.
_SIDE_BY_SIDE = 64
# Noise is judged by centres this far apart in time, s, if there are so many; the median of χ² with two degrees.
_LAG = 0.2
_FEWEST_TRIPLES = 20
_CHI2_MEDIAN = 1.386
_HALVINGS = 24
# The part of unmodelled noise, as a variance, that lasts longer than smoothing reaches.
_LASTING = 0.5


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The motion of one object at the times when its centre was measured and believed."""

    members: NDArray[np.intp]
    """(T,) its clusters, in order of time."""
    mean: Array
    """(T, 4) x, y (m), vx, vy (m/s), sensor frame."""
    covariance: Array
    """(T, 4, 4)."""


def smooth_all(
    pieces: Sequence[NDArray[np.intp]], times: Array, measured: Centres, agility: float
) -> tuple[Smoothed, ...]:
    """Smooths each piece by itself.

    Args:
        pieces: the clusters of each.
        times: (C,) of the clusters, s.
        measured: (C,) their centres; those without one, and those that contradict the motion, are left out.
        agility: spectral density of the acceleration, m²/s³.

    Returns:
        One motion for each piece, in their order; an empty one where nothing was measured.
    """
    there = np.asarray(np.isfinite(measured.positions).all(axis=1))
    kept = [_in_time(members[there[members]], times) for members in pieces]
    result = [Smoothed(members, np.empty((0, 4)), np.empty((0, 4, 4))) for members in kept]
    by_length = [i for i in sorted(range(len(kept)), key=lambda i: len(kept[i])) if len(kept[i])]
    for low in range(0, len(by_length), _SIDE_BY_SIDE):
        portion = by_length[low : low + _SIDE_BY_SIDE]
        together = _together([kept[i] for i in portion], times, measured, agility)
        for i, smoothed in zip(portion, together, strict=True):
            result[i] = smoothed
    return tuple(result)


def with_unmodelled_noise(
    pieces: Sequence[NDArray[np.intp]], times: Array, measured: Centres, agility: float
) -> Centres:
    """The same centres with the noise that their scatter about the motion shows beyond the stated one.

    A person seen now by one leg and now by both is not where an ellipse says. Every centre is compared with the
    line between those about a fifth of a second before and after; what noise and acceleration do not explain,
    in the median, is added to all. A part of it is kept as bias, because it lasts for a step of the walk.
    """
    there = np.asarray(np.isfinite(measured.positions).all(axis=1))
    kept = [_in_time(members[there[members]], times) for members in pieces]
    triples = np.concatenate([_triples(members, times) for members in kept]) if kept else np.empty((0, 3), int)
    if len(triples) < _FEWEST_TRIPLES:
        return measured
    before, here, after = triples.T
    late, early = times[here] - times[before], times[after] - times[here]
    w = (early / (late + early))[:, None]
    off = measured.positions[here] - w * measured.positions[before] - (1 - w) * measured.positions[after]
    share = w[..., None] ** 2
    V = measured.noise[here] + share * measured.noise[before] + (1 - w[..., None]) ** 2 * measured.noise[after]
    # The second difference of twice integrated white noise (Särkkä, section 6.2).
    V = V + (agility * (late * early) ** 1.5 / 6)[:, None, None] * np.eye(2)
    low, high = 0.0, float((off**2).sum(axis=1).max())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(V + 1.5 * middle * np.eye(2)), off)
        low, high = (middle, high) if np.median(squared) > _CHI2_MEDIAN else (low, middle)
    extra = low * np.eye(2)
    return Centres(measured.positions, measured.noise + extra, measured.bias + _LASTING * extra)


def _triples(members: NDArray[np.intp], times: Array) -> NDArray[np.intp]:
    """(N, 3) of the clusters about ``_LAG`` before, at, and about as long after a time."""
    t = times[members]
    before, after = np.searchsorted(t, t - 1.25 * _LAG), np.searchsorted(t, t + 0.75 * _LAG)
    inside = np.flatnonzero(after < len(t))
    i, j, k = before[inside], inside, after[inside]
    near = (t[j] - t[i] > 0.5 * _LAG) & (t[k] - t[j] < 1.5 * _LAG)
    return np.asarray(np.stack([members[i], members[j], members[k]], axis=1)[near])


def _in_time(members: NDArray[np.intp], times: Array) -> NDArray[np.intp]:
    return members[np.argsort(times[members], kind="stable")]


def _together(
    pieces: Sequence[NDArray[np.intp]], times: Array, measured: Centres, agility: float
) -> list[Smoothed]:
    """Smooths pieces padded to the longest; the padding repeats the last time without a measurement."""
    lengths = np.array([len(members) for members in pieces])
    column = np.arange(lengths.max())
    index = np.stack([members[np.minimum(column, len(members) - 1)] for members in pieces])
    z = np.where((column < lengths[:, None])[..., None], measured.positions[index], np.nan)
    state, used = smooth(times[index], z, measured.noise[index], agility, GATE)
    chosen = [np.flatnonzero(row) for row in used]
    return [
        Smoothed(members[steps], state.mean[k, steps], state.covariance[k, steps])
        for k, (members, steps) in enumerate(zip(pieces, chosen, strict=True))
    ]

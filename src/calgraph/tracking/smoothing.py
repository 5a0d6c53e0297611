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

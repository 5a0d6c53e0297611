"""Periods: intervals of time with a constant set of visible objects (lrf-network, section III-C)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class TrackSegment:
    """One identity within one period."""

    period: int
    members: NDArray[np.intp]
    """(T,) its clusters, in order of time."""


def split_into_periods(
    identities: Sequence[NDArray[np.intp]], scan: NDArray[np.intp], times: Array, max_undetected: float
) -> tuple[TrackSegment, ...]:
    """Splits identities wherever the set of visible objects changes, or they are not detected themselves.

    Args:
        identities: clusters of each, in order of time.
        scan: (C,) the scan of each cluster.
        times: (C,) s.
        max_undetected: an object that is not detected for longer has left the view, s.

    Returns:
        The segments by period, then in the order of the identities; periods are numbered from 0.
    """
    intervals = [
        s
        for members in identities
        for s in np.split(members, np.flatnonzero(np.diff(times[members]) > max_undetected) + 1)
    ]
    if not intervals:
        return ()
    # The set changes where an interval begins, and after its last scan.
    changes = np.unique([(scan[s[0]], scan[s[-1]] + 1) for s in intervals])
    segments: list[TrackSegment] = []
    for interval in intervals:
        period = np.searchsorted(changes, scan[interval], side="right") - 1
        cuts = np.flatnonzero(np.diff(period)) + 1
        parts = zip(np.split(period, cuts), np.split(interval, cuts), strict=True)
        segments.extend(TrackSegment(int(numbers[0]), members) for numbers, members in parts)
    renumbered = {period: n for n, period in enumerate(sorted({segment.period for segment in segments}))}
    return tuple(
        sorted(
            (TrackSegment(renumbered[p.period], p.members) for p in segments), key=lambda segment: segment.period
        )
    )

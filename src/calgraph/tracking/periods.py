"""Stretches of time in which a scanner sees the same objects all the time (lrf-network, section III-C)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# An object out of sight for longer has vanished, s.
_GAP = 0.4


@dataclass(frozen=True, eq=False)
class Piece:
    """One identity within one period."""

    period: int
    members: NDArray[np.intp]
    """(T,) its clusters, in order of time."""


def cut_into_periods(
    identities: Sequence[NDArray[np.intp]], scan: NDArray[np.intp], times: Array
) -> tuple[Piece, ...]:
    """Cuts identities wherever the set of visible objects changes, or they are out of sight themselves.

    Args:
        identities: clusters of each, in order of time.
        scan: (C,) the scan of each cluster.
        times: (C,) s.

    Returns:
        The pieces by period, then in the order of the identities; periods are numbered from 0.
    """
    stretches = [s for members in identities for s in np.split(members, _gaps(times[members]))]
    if not stretches:
        return ()
    # The set changes where a stretch begins, and after its last scan.
    changes = np.unique([(scan[s[0]], scan[s[-1]] + 1) for s in stretches])
    pieces: list[Piece] = []
    for stretch in stretches:
        period = np.searchsorted(changes, scan[stretch], side="right") - 1
        cuts = np.flatnonzero(np.diff(period)) + 1
        parts = zip(np.split(period, cuts), np.split(stretch, cuts), strict=True)
        pieces.extend(Piece(int(numbers[0]), members) for numbers, members in parts)
    renumbered = {period: n for n, period in enumerate(sorted({piece.period for piece in pieces}))}
    return tuple(sorted((Piece(renumbered[p.period], p.members) for p in pieces), key=lambda piece: piece.period))


def _gaps(times: Array) -> NDArray[np.intp]:
    return np.flatnonzero(np.diff(times) > _GAP) + 1

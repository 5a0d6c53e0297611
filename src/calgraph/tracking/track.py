"""What one scanner knows after a recording: the objects it followed, and what stood still."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class Hits:
    """The beams that ended on one object, in order of time."""

    points: Array
    """(N, 2) where they ended, sensor frame, m."""
    times: Array
    """(N,) when they were measured, s."""
    owner: NDArray[np.intp]
    """(N,) which of the track's times they belong to, ascending; each time has some."""


NO_HITS = Hits(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.intp))


@dataclass(frozen=True, eq=False)
class Track:
    """One object followed by one scanner through one unbroken stretch of time."""

    times: Array
    """(T,) when its points were measured (mean time of its beams), ascending, s."""
    positions: Array
    """(T, 2) smoothed centre, sensor frame, m."""
    velocities: Array
    """(T, 2) smoothed velocity, sensor frame, m/s."""
    covariances: Array
    """(T, 2, 2) of the positions, m²."""
    period: int
    """The set of visible objects is constant within a period of the scanner."""
    hits: Hits = NO_HITS
    """What it was measured by; none where only its positions are known."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one scanner knows: its tracks, and the static background it sees."""

    tracks: tuple[Track, ...]
    """By period, then by time."""
    background: Array
    """(M, 2) static points, sensor frame, m, in order of angle; NaN rows between breaks are not used."""
    sigma: float
    """Range noise seen on the background, m."""
    watched: Array | None = None
    """(W, 2) from when to when it measured without a break, s; without, from its first track to its last one."""

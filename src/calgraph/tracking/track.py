"""What a stationary scanner knows after a recording: who moved where, and what stood still."""

from dataclasses import dataclass

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class Track:
    """One object followed by one scanner through one unbroken stretch of time."""

    times: Array
    """(T,) s, when its points were measured (mean time of its beams), ascending."""
    positions: Array
    """(T, 2) m, sensor frame: smoothed centre."""
    velocities: Array
    """(T, 2) m/s."""
    covariances: Array
    """(T, 2, 2) of the positions, m²."""
    period: int
    """The set of visible objects is constant within a period of the scanner."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one scanner knows: its tracks, and the static background it sees."""

    tracks: tuple[Track, ...]
    background: Array
    """(M, 2) static points, sensor frame, m, in order of angle; NaN rows between breaks are not used."""
    sigma: float
    """Range noise seen on the background, m."""

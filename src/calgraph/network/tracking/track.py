"""The result of tracking in one scanner: tracks of moving objects, and the static background."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Foreground


@dataclass(frozen=True, eq=False)
class Hits:
    """The beams that ended on one object, in order of time."""

    points: Array
    """(N, 2) end points, sensor frame, m."""
    times: Array
    """(N,) times of measurement, s."""
    time_index: NDArray[np.intp]
    """(N,) index of the track's time that each belongs to, ascending; every time has at least one."""


NO_HITS = Hits(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.intp))


@dataclass(frozen=True, eq=False)
class Track:
    """One object in one scanner over one interval without a break."""

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
    """The beams that measured it; none where only positions are given."""

    def select(self, interval: tuple[float, float]) -> "Track":
        """The same with positions and beams between two stamps only, s."""
        first, end = np.searchsorted(self.times, interval[0]), np.searchsorted(self.times, interval[1], "right")
        hits = slice(*np.searchsorted(self.hits.time_index, [first, end]))
        chosen = slice(first, end)
        return replace(
            self,
            times=self.times[chosen],
            positions=self.positions[chosen],
            velocities=self.velocities[chosen],
            covariances=self.covariances[chosen],
            hits=Hits(self.hits.points[hits], self.hits.times[hits], self.hits.time_index[hits] - first),
        )


@dataclass(frozen=True)
class ScannerBump:
    """A step in the pose of a scanner during the recording."""

    interval: tuple[float, float]
    """Stamps between which the scanner moved, s."""
    translation: float
    """Displacement, m; NaN where the backgrounds before and after it have too little in common."""
    rotation: float
    """rad, counter-clockwise; NaN likewise."""
    translation_stddev: float
    """m."""
    rotation_stddev: float
    """rad."""


@dataclass(frozen=True, eq=False)
class ScannerTracks:
    """Tracks and static background of one scanner."""

    tracks: tuple[Track, ...]
    """By period, then by time."""
    background: Array
    """(M, 2) static points, sensor frame, m, in order of angle; NaN rows between breaks are not used."""
    sigma: float
    """Range noise, measured on the background, m."""
    coverage: Array | None = None
    """(W, 2) start and end of the intervals in which it measured, s; None: from its first to its last track."""
    bumps: tuple[ScannerBump, ...] = ()
    """Steps in the pose of the scanner during the recording, in order of time;"""
    interval: tuple[float, float] = (-np.inf, np.inf)
    """tracks and background are from scans between these stamps only, s, in which it stood still."""
    foreground: Foreground | None = None
    """The beams that end before the static background, tracked or not; None where only tracks are given."""
    background_tested: bool = False
    """Whether it measured enough static background to find bumps."""

    def select(self, interval: tuple[float, float]) -> "ScannerTracks":
        """The same with positions and beams between two stamps only, s."""
        tracks = (track.select(interval) for track in self.tracks)
        kept = tuple(track for track in tracks if len(track.times))
        coverage, beams = self.coverage, self.foreground
        if coverage is not None:
            coverage = np.clip(coverage, *interval)
            coverage = coverage[coverage[:, 1] > coverage[:, 0]]
        if beams is not None:
            beams = beams.select((beams.times >= interval[0]) & (beams.times <= interval[1]))
        return replace(self, tracks=kept, coverage=coverage, foreground=beams, interval=interval)

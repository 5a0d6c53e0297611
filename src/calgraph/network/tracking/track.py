"""The result of tracking in one scanner: tracks, the static background, and corrected tracks."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Foreground
from calgraph.sensors.untimed_scans import UntimedScans


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
    untimed: UntimedScans | None = None
    """Its scans, where they have no times of beams."""

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


TRACK_TYPES = (ScannerTracks, Track, Hits, ScannerBump, Foreground, UntimedScans, Rejected)
"""The classes in the tracks of a scanner, or in why it has none, which :mod:`calgraph.io.records` keeps."""


def correct_tracks(tracked: ScannerTracks, *, clock_offset: float = 0.0, inverted: bool = False) -> ScannerTracks:
    """The same tracks with times of another clock, and in the frame of a scanner mounted the other way up.

    A scanner that is mounted upside-down observes the plane from below. The frame that is rotated by 180° about
    its x axis has the same x and the opposite y and angles. Bumps keep the scanner's clock and frame.

    Args:
        tracked: tracks, beams and background of a scanner.
        clock_offset: the scanner's clock minus the other clock, s.
        inverted: whether to mirror everything at the x axis.
    """
    if not clock_offset and not inverted:
        return tracked
    signs = np.array([1.0, -1.0 if inverted else 1.0])
    # Static points are in order of angle, which mirroring reverses.
    background = tracked.background[::-1] if inverted else tracked.background
    beams = tracked.foreground
    return replace(
        tracked,
        tracks=tuple(_correct_track(track, clock_offset, signs) for track in tracked.tracks),
        background=background * signs,
        coverage=None if tracked.coverage is None else tracked.coverage - clock_offset,
        foreground=beams and replace(beams, angles=beams.angles * signs[1], times=beams.times - clock_offset),
    )


def _correct_track(track: Track, clock_offset: float, signs: Array) -> Track:
    return replace(
        track,
        times=track.times - clock_offset,
        positions=track.positions * signs,
        velocities=track.velocities * signs,
        covariances=track.covariances * np.outer(signs, signs),
        hits=replace(track.hits, points=track.hits.points * signs, times=track.hits.times - clock_offset),
    )

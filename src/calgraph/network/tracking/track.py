"""The result of tracking in one scanner: tracks, the static background, their archive, and corrected tracks."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
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
    return replace(
        tracked,
        tracks=tuple(_correct_track(track, clock_offset, signs) for track in tracked.tracks),
        background=background * signs,
        coverage=None if tracked.coverage is None else tracked.coverage - clock_offset,
        foreground=tracked.foreground and _correct_foreground(tracked.foreground, clock_offset, signs),
    )


def _correct_foreground(foreground: Foreground, clock_offset: float, signs: Array) -> Foreground:
    return replace(foreground, angles=foreground.angles * signs[1], times=foreground.times - clock_offset)


def _correct_track(track: Track, clock_offset: float, signs: Array) -> Track:
    return replace(
        track,
        times=track.times - clock_offset,
        positions=track.positions * signs,
        velocities=track.velocities * signs,
        covariances=track.covariances * np.outer(signs, signs),
        hits=replace(track.hits, points=track.hits.points * signs, times=track.hits.times - clock_offset),
    )


_TRACKS = Table("tracks", {
    "period": INDEX, "times": Column(ragged=True), "positions": Column((2,), ragged=True),
    "velocities": Column((2,), ragged=True), "covariances": Column((2, 2), ragged=True),
})  # fmt: skip
_HITS = Table("hits", {
    "points": Column((2,), ragged=True), "times": Column(ragged=True),
    "time_index": Column(dtype=np.intp, ragged=True),
})  # fmt: skip
_BUMPS = Table("bumps", {
    "interval": Column((2,)), "translation": NUMBER, "rotation": NUMBER, "translation_stddev": NUMBER,
    "rotation_stddev": NUMBER,
})  # fmt: skip
_FOREGROUND = "foreground/"


def encode_tracks(tracked: ScannerTracks | Rejected) -> tuple[dict[str, Any], Arrays]:
    """The tracks of one scanner, or why there are none."""
    if isinstance(tracked, Rejected):
        return {"rejected": tracked.reason}, {}
    arrays: dict[str, NDArray[Any]] = {
        "background": tracked.background,
        "sigma": np.array(tracked.sigma),
        "interval": np.array(tracked.interval),
        **_TRACKS.pack([vars(track) for track in tracked.tracks]),
        **_HITS.pack([vars(track.hits) for track in tracked.tracks]),
        **_BUMPS.pack([vars(bump) for bump in tracked.bumps]),
    }
    if tracked.coverage is not None:
        arrays["coverage"] = tracked.coverage
    if tracked.untimed is not None:
        arrays["untimed"] = np.array(astuple(tracked.untimed))
    if tracked.foreground is not None:
        arrays |= {f"{_FOREGROUND}{name}": values for name, values in vars(tracked.foreground).items()}
    return {"rejected": None, "background_tested": tracked.background_tested}, arrays


def decode_tracks(content: Mapping[str, Any], arrays: Arrays) -> ScannerTracks | Rejected:
    """The tracks from what :func:`encode_tracks` gives.

    Raises:
        InputError: a column is missing, or its values do not fit the others.
        KeyError: a key is missing.
    """
    if content["rejected"] is not None:
        return Rejected(content["rejected"])
    beams = {
        name.removeprefix(_FOREGROUND): values for name, values in arrays.items() if name.startswith(_FOREGROUND)
    }
    tracks = zip(_TRACKS.unpack(arrays), _HITS.unpack(arrays), strict=True)
    start, end = arrays["interval"].tolist()
    return ScannerTracks(
        tuple(Track(**track, hits=Hits(**hits)) for track, hits in tracks),
        arrays["background"],
        float(arrays["sigma"]),
        arrays.get("coverage"),
        tuple(
            ScannerBump(**{**bump, "interval": tuple(bump["interval"].tolist())}) for bump in _BUMPS.unpack(arrays)
        ),
        (start, end),
        Foreground(**beams) if beams else None,
        content["background_tested"],
        UntimedScans(*arrays["untimed"].tolist()) if "untimed" in arrays else None,
    )

"""Tracks of a recording that grows: each interval of it is tracked once."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil
from pathlib import Path

import numpy as np

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.options import NetworkOptions
from calgraph.network.track_recording import track_people
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import ScannerBump, ScannerTracks
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.recording import ClosedOnExit
from calgraph.result import CaptureRow
from calgraph.sensors import RecordedMessage

Tracked = Mapping[str, ScannerTracks | Rejected]
"""The tracks of each scanner, or why it has none."""


def join_tracks(intervals: Sequence[Tracked], max_gap: float) -> dict[str, ScannerTracks | Rejected]:
    """Joins the tracks of each scanner over intervals.

    What is tracked twice is of the earlier interval. A person who is in view when it ends has a track before and
    one after it; all else is as in tracks of the whole.

    Args:
        intervals: in order of time, one at least; all of the same scanners.
        max_gap: longest time without a scan between two intervals in which the scanner measured without a break,
            s.
    """
    return {name: _join_scanner([tracked[name] for tracked in intervals], max_gap) for name in intervals[0]}


def _join_scanner(found: Sequence[ScannerTracks | Rejected], max_gap: float) -> ScannerTracks | Rejected:
    parts = [one for one in found if isinstance(one, ScannerTracks)]
    if not parts:
        return found[-1]
    parts, bumps = _select_last_pose(parts)
    parts = [parts[0], *(_remove_overlap(one, before) for before, one in pairwise(parts))]
    if len(parts) == 1:
        return replace(parts[0], bumps=bumps)
    periods = np.cumsum([0, *(1 + max((track.period for track in one.tracks), default=-1) for one in parts)])
    tracks = tuple(
        replace(track, period=track.period + int(first))
        for first, one in zip(periods[:-1], parts, strict=True)
        for track in one.tracks
    )
    longest = max(parts, key=_covered_time)
    coverage = [one.coverage for one in parts if one.coverage is not None]
    return ScannerTracks(
        tracks,
        longest.background,
        longest.sigma,
        _join_coverage(np.concatenate(coverage), max_gap) if coverage else None,
        bumps,
        (parts[0].interval[0], parts[-1].interval[1]),
        _join_foregrounds([one.foreground for one in parts if one.foreground is not None]),
        longest.background_tested,
    )


def _select_last_pose(parts: list[ScannerTracks]) -> tuple[list[ScannerTracks], tuple[ScannerBump, ...]]:
    """The intervals after the last bump, which the one of the bump may belong to; and the bumps in it."""
    bumped = [k for k, one in enumerate(parts) if one.bumps]
    if not bumped:
        return parts, ()
    last = bumped[-1]
    is_after = parts[last].interval[1] == np.inf
    return parts[last if is_after or last == len(parts) - 1 else last + 1 :], parts[last].bumps


def _remove_overlap(tracked: ScannerTracks, before: ScannerTracks) -> ScannerTracks:
    """The tracks of an interval after the last scan of the one before, by the clock of the scanner."""
    if before.coverage is None or not len(before.coverage):
        return tracked
    last = float(before.coverage[-1, 1])
    return replace(tracked.select((np.nextafter(last, np.inf), np.inf)), interval=tracked.interval)


def _covered_time(tracked: ScannerTracks) -> float:
    return 0.0 if tracked.coverage is None else float(np.sum(np.diff(tracked.coverage, axis=1)))


def _join_coverage(coverage: Array, max_gap: float) -> Array:
    """Intervals (W, 2), s, of which those with less than ``max_gap`` between them are one."""
    breaks = np.flatnonzero(coverage[1:, 0] - coverage[:-1, 1] > max_gap)
    return np.column_stack([coverage[[0, *breaks + 1], 0], coverage[[*breaks, -1], 1]])


def _join_foregrounds(parts: Sequence[Foreground]) -> Foreground | None:
    """The beams of all parts, whose scans are numbered in their order."""
    if not parts:
        return None
    first = np.cumsum([0, *(len(one.spacing) for one in parts)])[:-1]
    numbered = [replace(one, scan=one.scan + start) for one, start in zip(parts, first, strict=True)]
    columns = {name: np.concatenate([vars(one)[name] for one in numbered]) for name in vars(numbered[0])}
    return Foreground(**columns)


class RecordingWindow(ClosedOnExit):
    """The messages of a recording that arrived in an interval; it stays open when the window is closed.

    Args:
        recording: the whole.
        start: first arrival, s.
        end: last arrival, s.
    """

    def __init__(self, recording: Recording, start: float, end: float) -> None:
        self._recording = recording
        self.path: Path = recording.path
        # What is computed from a window is not kept: its files have other messages, too.
        self.sources: tuple[Path, ...] = ()
        self.start, self.end = start, end
        self.last_arrival = start
        """Of the messages that were read so far, s."""
        share = (end - start) / max(recording.end - recording.start, 1e-9)
        self.topics = tuple(replace(topic, count=ceil(topic.count * share)) for topic in recording.topics)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages in order of arrival; see :meth:`calgraph.recording.Recording.records`."""
        first = self.start if start is None else max(start, self.start)
        last = self.end if end is None else min(end, self.end)
        for record in self._recording.records(topics, first, last):
            self.last_arrival = max(self.last_arrival, record.arrival)
            yield record


@dataclass(frozen=True, eq=False)
class TrackedInterval:
    """An interval of a recording, and the tracks in it."""

    start: float
    """Arrival of its first message, s; likewise the last."""
    end: float
    tracked: Tracked

    @property
    def duration(self) -> float:
        """Time that it takes, s."""
        return self.end - self.start

    @property
    def positions(self) -> int:
        """Number of positions in its tracks, to which the time of a solution is proportional."""
        found = [one for one in self.tracked.values() if isinstance(one, ScannerTracks)]
        return sum(len(track.times) for one in found for track in one.tracks)


@dataclass(frozen=True, eq=False)
class TrackingProgress:
    """How far a recording has been tracked in intervals."""

    intervals: tuple[TrackedInterval, ...] = ()
    """Whose tracks are still used, in order of time."""
    until: float | None = None
    """End of the last interval, used or not, s; None before the first."""
    duration: float = 0.0
    """Of all intervals, used or not, s."""


# Minimum time after the last of these intervals that is tracked, s: with the overlap 25 s, in half of which
# people do not stand still.
MIN_INTERVAL = 10.0
# Maximum number of intervals that are tracked before a solution, of sessions that are resumed: 10 s of work for
# ten scanners.
_MAX_INTERVALS = 4


def track_recording(
    rig: Rig, recording: Recording, progress: TrackingProgress, monitor: InputMonitor
) -> tuple[TrackingProgress, TrackedInterval | None]:
    """Tracks what was recorded since the last call.

    Args:
        rig: the network.
        recording: until now.
        progress: of the last call, without the intervals that are no longer used.
        monitor: observes the messages.

    Returns:
        The progress until now, and the time after its intervals, which the next call tracks again; None if that is
        too short, or too much is to be tracked.
    """
    length = rig.settings.live.network.interval
    for _ in range(_MAX_INTERVALS):
        start = _find_start(recording, progress.until, rig)
        if recording.end - start < length + MIN_INTERVAL:
            if progress.until is not None and recording.end - start < MIN_INTERVAL:
                return progress, None
            return progress, _track_interval(rig, recording, start, recording.end, progress.until, monitor)
        interval = _track_interval(rig, recording, start, start + length, progress.until, monitor)
        progress = TrackingProgress(
            (*progress.intervals, interval), interval.end, progress.duration + interval.duration
        )
    return progress, None


def _find_start(recording: Recording, until: float | None, rig: Rig) -> float:
    """Where the next interval begins, s: at the first arrival after the last one, which may be of a later run."""
    if until is None:
        return recording.start
    present = {topic.name for topic in recording.topics}.intersection(rig.topics.values())
    record = next(iter(recording.records(present, math.nextafter(until, math.inf))), None)
    return recording.end if record is None else record.arrival


# Time before an interval that is tracked with it, s, whose tracks are those of the one before: a scanner that is
# moved between the two has 10 s at rest before and after it.
_OVERLAP = 15.0


def _track_interval(
    rig: Rig, recording: Recording, start: float, end: float, until: float | None, monitor: InputMonitor
) -> TrackedInterval:
    """Tracks an interval with the end of the one before, so that scanners that are moved between them are noticed.

    Of some scanners the recording has no message yet.
    """
    first = start if until is None else until - _OVERLAP
    window = RecordingWindow(recording, max(first, recording.start), end)
    present = {topic.name for topic in window.topics}
    sensors = {name: spec for name, spec in rig.sensors.items() if spec.topic in present}
    found, _ = track_people(rig.model_copy(update={"sensors": sensors}), window, NetworkOptions(), monitor=monitor)
    tracked = {name: found.get(name, Rejected("it has sent no messages yet")) for name in rig.sensors}
    return TrackedInterval(start, window.last_arrival, tracked)


def select_intervals(
    intervals: Sequence[TrackedInterval], rows: Sequence[CaptureRow], start: float, max_positions: float
) -> tuple[TrackedInterval, ...]:
    """Drops intervals as long as all have too many positions.

    The one that goes first has the least of the time in which people were tracked by several scanners, as a share
    of that of each scanner, summed over all scanners: a scanner whose view people seldom enter keeps what it has.

    Args:
        intervals: all, in order of time.
        rows: the tracks, and whether other scanners have them too; all count of scanners that share none.
        start: of the recording, s.
        max_positions: maximum number of all together; one interval always stays.
    """
    sharing = {row.sensor for row in rows if row.used}
    counted = [row for row in rows if row.used or row.sensor not in sharing]
    names = sorted({row.sensor for row in counted})
    seconds = np.zeros((len(intervals), len(names)))
    for k, interval in enumerate(intervals):
        for row in counted:
            overlap = min(row.end, interval.end - start) - max(row.start, interval.start - start)
            seconds[k, names.index(row.sensor)] += max(overlap, 0.0)
    positions = np.array([interval.positions for interval in intervals])
    kept = list(range(len(intervals)))
    while len(kept) > 1 and np.sum(positions[kept]) > max_positions:
        shares = seconds[kept] / np.maximum(np.sum(seconds[kept], axis=0), 1e-9)
        kept.pop(int(np.argmin(np.sum(shares, axis=1) / np.maximum(positions[kept], 1))))
    return tuple(intervals[k] for k in kept)

"""Tracks of a recording that grows: each interval of it is tracked once, and its tracks are kept in a file."""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from math import nextafter
from pathlib import Path

from calgraph.calibrate import NetworkOptions, track_people
from calgraph.captures import InputMonitor
from calgraph.config import Rig
from calgraph.config.settings import LiveNetworkSettings
from calgraph.errors import Rejected
from calgraph.io.archive import read_archive, write_archive
from calgraph.live.joined_tracks import Tracked
from calgraph.live.recording_window import RecordingWindow
from calgraph.recording import Recording
from calgraph.result import CaptureRow
from calgraph.tracking import ScannerTracks, decode_tracks, encode_tracks

_FORMAT = "calgraph-live-tracks/1"
_MEMBER = "tracks.json"


@dataclass(frozen=True)
class TrackedInterval:
    """An interval whose tracks are in a file."""

    start: float
    """Arrival of its first message, s; likewise the last."""
    end: float
    positions: int
    """Number of positions in its tracks, to which the time of a solution is proportional."""


@dataclass(frozen=True, eq=False)
class TrackedRecording:
    """The tracks of a recording until now."""

    intervals: tuple[TrackedInterval, ...]
    """Those in files, in order of time."""
    parts: tuple[Tracked, ...]
    """Their tracks, and those of the time after them, if it is long enough."""
    kept_until: float | None
    """End of the last interval whose tracks were ever in a file, s; None before the first."""
    tracked_until: float
    """Arrival up to which messages were tracked, s."""


def track_recording(
    rig: Rig,
    recording: Recording,
    folder: Path,
    kept: Sequence[TrackedInterval],
    kept_until: float | None,
    monitor: InputMonitor,
) -> TrackedRecording:
    """Tracks what was recorded since the last call.

    Args:
        rig: the network.
        recording: until now.
        folder: of the files with tracks.
        kept: the intervals whose tracks are in files, and still used.
        kept_until: end of the last interval whose tracks were ever in a file, s; None before the first.
        monitor: observes the messages.
    """
    settings = rig.settings.live.network
    intervals = list(kept)
    parts = [_read_tracks(rig, _name_file(folder, interval)) for interval in intervals]
    closed = 0
    while (
        recording.end - (start := _start_after(kept_until, recording)) >= settings.interval + settings.min_interval
    ):
        if closed == settings.max_intervals:
            return TrackedRecording(tuple(intervals), tuple(parts), kept_until, start)
        kept_until = start + settings.interval
        tracked = _track_window(rig, RecordingWindow(recording, start, kept_until), monitor)
        interval = TrackedInterval(start, kept_until, _count_positions(tracked))
        _write_tracks(_name_file(folder, interval), tracked)
        intervals.append(interval)
        parts.append(tracked)
        closed += 1
    if parts and recording.end - start < settings.min_interval:
        return TrackedRecording(tuple(intervals), tuple(parts), kept_until, start)
    parts.append(_track_window(rig, RecordingWindow(recording, start, recording.end), monitor))
    return TrackedRecording(tuple(intervals), tuple(parts), kept_until, recording.end)


def _start_after(kept_until: float | None, recording: Recording) -> float:
    """Where the next interval begins: after the last arrival of the one before."""
    return recording.start if kept_until is None else nextafter(kept_until, float("inf"))


def _track_window(rig: Rig, window: RecordingWindow, monitor: InputMonitor) -> Tracked:
    """The tracks of all scanners; of some the recording has no message yet."""
    present = {topic.name for topic in window.topics}
    sensors = {name: spec for name, spec in rig.sensors.items() if spec.topic in present}
    found, _ = track_people(rig.model_copy(update={"sensors": sensors}), window, NetworkOptions(), monitor=monitor)
    return {name: found.get(name, Rejected("it has sent no messages yet")) for name in rig.sensors}


def select_intervals(
    intervals: Sequence[TrackedInterval],
    rows: Sequence[CaptureRow],
    start: float,
    settings: LiveNetworkSettings,
) -> tuple[TrackedInterval, ...]:
    """Drops intervals as long as all have more positions than are solved for.

    The one that goes first has the least of the time in which people were tracked by several scanners, as a share
    of that of each scanner, summed over all scanners: a scanner whose view people seldom enter keeps what it has.

    Args:
        intervals: all, in order of time.
        rows: the tracks, and whether other scanners have them too; all count of scanners that share none.
        start: of the recording, s.
        settings: ``max_positions``.
    """
    kept = list(intervals)
    sharing = {row.sensor for row in rows if row.used}
    counted = [row for row in rows if row.used or row.sensor not in sharing]
    seconds = {
        interval: _sum_by_scanner(counted, interval.start - start, interval.end - start) for interval in kept
    }
    while len(kept) > 1 and sum(interval.positions for interval in kept) > settings.max_positions:
        total: dict[str, float] = {}
        for interval in kept:
            for name, duration in seconds[interval].items():
                total[name] = total.get(name, 0.0) + duration
        kept.remove(
            min(
                kept,
                key=lambda one: (
                    sum(duration / max(total[name], 1e-9) for name, duration in seconds[one].items())
                    / max(one.positions, 1)
                ),
            )
        )
    return tuple(kept)


def remove_files(folder: Path, kept: Sequence[TrackedInterval]) -> None:
    """Removes the files of all other intervals."""
    names = {_name_file(folder, interval) for interval in kept}
    for file in folder.glob("*.npz"):
        if file not in names:
            file.unlink(missing_ok=True)


def _sum_by_scanner(rows: Sequence[CaptureRow], start: float, end: float) -> dict[str, float]:
    """Duration of the tracks within an interval, s, by scanner."""
    sums: dict[str, float] = {}
    for row in rows:
        sums[row.sensor] = sums.get(row.sensor, 0.0) + max(min(row.end, end) - max(row.start, start), 0.0)
    return sums


def _count_positions(tracked: Tracked) -> int:
    return sum(
        len(track.times) for one in tracked.values() if isinstance(one, ScannerTracks) for track in one.tracks
    )


def _name_file(folder: Path, interval: TrackedInterval) -> Path:
    return folder / f"{round(interval.start * 1e9)}.npz"


def _write_tracks(path: Path, tracked: Tracked) -> None:
    encoded = [encode_tracks(one) for one in tracked.values()]
    write_archive(
        path,
        _MEMBER,
        {"format": _FORMAT, "scanners": [content for content, _ in encoded]},
        {f"{k}/{name}": array for k, (_, arrays) in enumerate(encoded) for name, array in arrays.items()},
        compression=zipfile.ZIP_STORED,
    )


def _read_tracks(rig: Rig, path: Path) -> Tracked:
    content, arrays = read_archive(path, _MEMBER, _FORMAT, rig.settings.limits.max_archive_bytes)
    tracked: dict[str, ScannerTracks | Rejected] = {}
    for k, (name, one) in enumerate(zip(rig.sensors, content["scanners"], strict=True)):
        prefix = f"{k}/"
        columns = {key.removeprefix(prefix): values for key, values in arrays.items() if key.startswith(prefix)}
        tracked[name] = decode_tracks(one, columns)
    return tracked

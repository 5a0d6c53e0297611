"""From holds to detections: each hold's messages are gathered from the stream, searched, and let go."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calgraph.captures.camera_noise import with_measured_noise
from calgraph.captures.holds import Hold
from calgraph.captures.previews import Detail, snapshot
from calgraph.captures.timeline import Timeline
from calgraph.config import Rig
from calgraph.detection import Detection
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.result import Snapshot
from calgraph.sensors import CameraModel, Message, RecordedMessage

Detect = Callable[[Sequence[Any]], tuple[Detection, ...] | Rejected]
"""Finds the board in the messages that one sensor sent during one hold."""

# More messages of a resting board sharpen the detection only slowly; images also cost the most time.
_AT_MOST = {"camera": 2, "lidar2d": 20, "lidar3d": 5}


@dataclass(frozen=True, eq=False)
class Observation:
    """What one sensor saw in one capture."""

    capture: int
    sensor: str
    found: tuple[Detection, ...] | Rejected
    snapshot: Snapshot | None = None
    """What it looked like, where that is kept."""


@dataclass(frozen=True, eq=False)
class Captured:
    """All that a recording says of a rig: everything the solvers need."""

    start: float
    """Start of the recording, s."""
    frames: Mapping[str, str]
    """frame_id by sensor, as its messages state it."""
    holds: tuple[Hold, ...]
    detections: Mapping[str, Mapping[int, tuple[Detection, ...]]]
    """By sensor and capture; several candidates where it is open which of them is the board."""
    misses: Mapping[tuple[int, str], str]
    """By capture and sensor, why there is no detection."""
    cameras: Mapping[str, CameraModel]
    """Intrinsics by camera."""
    snapshots: tuple[Snapshot, ...] = ()
    """What the captures looked like, for pictures; not part of a dumped problem."""


def gather(
    rig: Rig,
    timeline: Timeline,
    holds: Sequence[Hold],
    observations: Iterable[Observation],
    cameras: Mapping[str, CameraModel],
) -> Captured:
    """Sorts observations into detections and misses; weighs cameras by the noise that all their corners show."""
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in timeline.sensors}
    misses: dict[tuple[int, str], str] = {}
    snapshots: list[Snapshot] = []
    for seen in observations:
        if seen.snapshot:
            snapshots.append(seen.snapshot)
        if isinstance(seen.found, Rejected):
            misses[seen.capture, seen.sensor] = seen.found.reason
        else:
            detections[seen.sensor][seen.capture] = seen.found
    for name, spec in rig.cameras().items():
        detections[name] = with_measured_noise(detections[name], spec.noise.pixel)
    frames = {name: times.frame_id for name, times in timeline.sensors.items()}
    return Captured(timeline.start, frames, tuple(holds), detections, misses, cameras, tuple(snapshots))


def observe(
    records: Iterable[RecordedMessage],
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    detect: Mapping[str, Detect],
    *,
    keep: Mapping[int, Detail] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[Observation]:
    """Detects the board for every sensor in every hold, with the messages of one hold in memory at a time.

    Args:
        records: all records of the sensors, streamed.
        holds: with the stamps of the messages to use.
        topics: topic by sensor.
        detect: detector by sensor.
        keep: by capture, how much of its messages is kept for pictures; nothing of captures that are not in it.
        progress: called with the number of observations made.

    Yields:
        One observation for every hold and sensor.
    """
    sensors = {topic: name for name, topic in topics.items()}
    wanted: dict[tuple[str, float], list[int]] = {}
    waiting: dict[tuple[int, str], int] = {}
    done = 0

    def observed(capture: int, name: str, messages: Sequence[Message]) -> Observation:
        detail = (keep or {}).get(capture)
        kept = snapshot(capture, name, messages, detail) if detail else None
        return Observation(capture, name, detect[name](messages), kept)

    for hold in holds:
        for name in topics:
            chosen = hold.stamps[name]
            waiting[hold.index, name] = len(chosen)
            for stamp in chosen:
                wanted.setdefault((name, float(stamp)), []).append(hold.index)
    gathered: dict[tuple[int, str], list[Message]] = {}
    for record in records:
        name = sensors.get(record.topic, "")
        for capture in wanted.pop((name, record.stamp), ()):
            key = capture, name
            gathered.setdefault(key, []).append(record.decode())
            waiting[key] -= 1
            if waiting[key] == 0:
                del waiting[key]
                done += 1
                yield observed(capture, name, gathered.pop(key))
                if progress:
                    progress(done)
    for capture, name in waiting:
        messages = gathered.get((capture, name))
        nothing = Rejected("no message was measured entirely within the hold")
        yield observed(capture, name, messages) if messages else Observation(capture, name, nothing)


def thinned(holds: Iterable[Hold], rig: Rig) -> tuple[Hold, ...]:
    """The same holds with as many messages of each sensor as are worth looking at, spread over the hold."""
    return tuple(
        replace(
            hold, stamps={n: _spread(stamps, _AT_MOST[rig.sensors[n].kind]) for n, stamps in hold.stamps.items()}
        )
        for hold in holds
    )


def _spread(stamps: Array, count: int) -> Array:
    if len(stamps) <= count:
        return stamps
    chosen: Array = stamps[np.linspace(0, len(stamps) - 1, count).round().astype(int)]
    return chosen

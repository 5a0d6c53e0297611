"""Holds: the times in which the board rests; and which messages of each sensor were measured in them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calgraph.captures.motion_detection import still_spans
from calgraph.captures.timeline import SensorTimes, Timeline
from calgraph.config import Capture
from calgraph.errors import CalibrationError
from calgraph.geometry import Array

# Messages of one pose in a folder of snapshots lie this close together (s), and poses farther apart.
_SNAPSHOT = 1.0
# A sensor slower than this (s between messages) shows no motion: it cannot tell when the board rests.
_SLOW = 0.5


@dataclass(frozen=True, eq=False)
class Hold:
    """One time in which the board rests."""

    index: int
    start: float
    end: float
    """s, header time."""
    stamps: Mapping[str, Array] = field(default_factory=dict)
    """By sensor, the stamps of the messages measured entirely within the hold."""


def find_holds(timeline: Timeline, capture: Capture) -> tuple[Hold, ...]:
    """Finds the holds: by trigger, from separate snapshots, or by stillness.

    Args:
        timeline: when the sensors measured, and when captures were triggered.
        capture: the trigger if there is one, and the windows in which no hold may lie.

    Returns:
        The holds in order of time, each with the messages to use.

    Raises:
        CalibrationError: there is none.
    """
    single = capture.trigger is None and is_snapshots(timeline)
    if capture.trigger:
        spans = _by_trigger(timeline)
    elif single:
        spans = _by_snapshot(timeline)
    else:
        spans = _by_stillness(timeline)
    closed = [*capture.exclude, *([capture.background] if capture.background else [])]
    allowed = [
        (start, end)
        for start, end in spans
        if not any(start - timeline.start < b and end - timeline.start > a for a, b in closed)
    ]
    if not allowed:
        raise CalibrationError(_why_none(timeline, capture))
    return tuple(
        Hold(i, start, end, {name: _within(times, start, end, single) for name, times in timeline.sensors.items()})
        for i, (start, end) in enumerate(allowed)
    )


def _why_none(timeline: Timeline, capture: Capture) -> str:
    if capture.trigger and not len(timeline.triggers):
        return (
            f"the topic {capture.trigger} has no message: check capture.trigger, or leave it out to find the "
            "holds from the data"
        )
    if capture.trigger:
        return (
            f"all {len(timeline.triggers)} messages of {capture.trigger} lie in capture.background or "
            "capture.exclude; make these shorter"
        )
    return "the board never rests: hold it still twice as long as the slowest sensor takes, or record a trigger"


def _by_trigger(timeline: Timeline) -> list[tuple[float, float]]:
    """From each trigger until every sensor has measured twice (MSG-Cal, III), or until the next trigger."""
    spans = []
    for start, following in zip(timeline.triggers, [*timeline.triggers[1:], np.inf], strict=True):
        second = [start]
        for times in timeline.sensors.values():
            after = np.unique(times.stamps[times.stamps >= start])
            if len(after) >= 2:
                second.append(after[1] + times.duration)
        spans.append((float(start), float(min(max(second), following))))
    return spans


def is_snapshots(timeline: Timeline) -> bool:
    """Whether the recording is a series of single shots: no two messages of a sensor within a shot's time."""
    gaps = [np.diff(times.stamps) for times in timeline.sensors.values() if len(times.stamps) > 1]
    return not gaps or bool(np.min(np.concatenate(gaps)) > 2 * _SNAPSHOT)


def _by_snapshot(timeline: Timeline) -> list[tuple[float, float]]:
    stamps = np.sort(np.concatenate([times.stamps for times in timeline.sensors.values()]))
    groups = np.split(stamps, np.flatnonzero(np.diff(stamps) > _SNAPSHOT) + 1)
    return [(float(group[0]), float(group[-1])) for group in groups if len(group) > 1]


def _by_stillness(timeline: Timeline) -> list[tuple[float, float]]:
    """Where no fast sensor sees a change for as long as the slowest needs to measure once in full."""
    fast = [times for times in timeline.sensors.values() if times.period <= _SLOW]
    if not fast:
        return []
    spans = [still_spans(times.stamps, times.activity) for times in fast]
    common = spans[0]
    for other in spans[1:]:
        common = _intersect(common, other)
    periods = [times.period for times in timeline.sensors.values() if np.isfinite(times.period)]
    shortest = max(0.5, *periods)
    return [(float(a), float(b)) for a, b in common if b - a >= shortest]


def _intersect(a: Array, b: Array) -> Array:
    """Overlaps of two sets of disjoint, ordered spans (N, 2) and (M, 2)."""
    start = np.maximum(a[:, None, 0], b[None, :, 0])
    end = np.minimum(a[:, None, 1], b[None, :, 1])
    overlap = start < end
    return np.stack([start[overlap], end[overlap]], axis=1)


def _within(times: SensorTimes, start: float, end: float, whole: bool) -> Array:
    """Stamps of the messages that were measured entirely between start and end.

    A sensor whose messages do not say how long they took may have stamped their first or their last point: only
    a message with one more before it in the hold is then safe (MSG-Cal's second measurement).
    """
    if whole:
        return times.stamps[(times.stamps >= start) & (times.stamps <= end)]
    inside = times.stamps[(times.stamps >= start) & (times.stamps + times.duration <= end + 1e-6)]
    return inside if times.duration > 0 else inside[1:]

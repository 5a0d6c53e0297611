"""Holds: the times in which the board rests; and which messages of each sensor were measured in them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from calgraph.captures.motion_detection import find_still_spans
from calgraph.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.config import Capture
from calgraph.config.settings import CaptureSettings
from calgraph.errors import CalibrationError
from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class Hold:
    """One time in which the board rests."""

    index: int
    start: float
    end: float
    """s, header time."""
    stamps: Mapping[str, Array] = field(default_factory=dict)
    """By sensor, the stamps of the messages measured entirely within the hold."""


def find_holds(
    timeline: RecordingTimeline, capture: Capture, settings: CaptureSettings = CaptureSettings()
) -> tuple[Hold, ...]:
    """Finds the holds: by trigger, from separate snapshots, or by stillness.

    Args:
        timeline: when the sensors measured, and when captures were triggered.
        capture: the trigger if there is one, and the windows in which no hold may lie.
        settings: of the search.

    Returns:
        The holds in order of time, each with the messages to use.

    Raises:
        CalibrationError: there is none.
    """
    snapshots = capture.trigger is None and is_snapshot_recording(timeline, settings.max_snapshot_gap)
    if capture.trigger:
        spans = _find_spans_by_trigger(timeline)
    elif snapshots:
        spans = _find_spans_of_snapshots(timeline, settings.max_snapshot_gap)
    else:
        spans = _find_spans_by_stillness(timeline, settings)
    excluded = [*capture.exclude, *([capture.background] if capture.background else [])]
    allowed = [
        (start, end)
        for start, end in spans
        if not any(start - timeline.start < b and end - timeline.start > a for a, b in excluded)
    ]
    if not allowed:
        raise CalibrationError(_explain_no_holds(timeline, capture))
    sensors = timeline.sensors.items()
    return tuple(
        Hold(i, start, end, {name: _select_stamps(times, start, end, snapshots) for name, times in sensors})
        for i, (start, end) in enumerate(allowed)
    )


def _explain_no_holds(timeline: RecordingTimeline, capture: Capture) -> str:
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


def _find_spans_by_trigger(timeline: RecordingTimeline) -> list[tuple[float, float]]:
    """From each trigger until every sensor has measured twice (MSG-Cal, III), or until the next trigger."""
    spans = []
    for start, next_trigger in pairwise([*timeline.triggers, np.inf]):
        measured_twice = [start]
        for times in timeline.sensors.values():
            after = np.unique(times.stamps[times.stamps >= start])
            if len(after) >= 2:
                measured_twice.append(after[1] + times.duration)
        spans.append((float(start), float(min(max(measured_twice), next_trigger))))
    return spans


def is_snapshot_recording(timeline: RecordingTimeline, max_gap: float) -> bool:
    """Whether no two messages of a sensor lie within twice ``max_gap``, s: each pose has one of each."""
    gaps = [np.diff(times.stamps) for times in timeline.sensors.values() if len(times.stamps) > 1]
    return not gaps or bool(np.min(np.concatenate(gaps)) > 2 * max_gap)


def _find_spans_of_snapshots(timeline: RecordingTimeline, max_gap: float) -> list[tuple[float, float]]:
    stamps = np.sort(np.concatenate([times.stamps for times in timeline.sensors.values()]))
    groups = np.split(stamps, np.flatnonzero(np.diff(stamps) > max_gap) + 1)
    return [(float(group[0]), float(group[-1])) for group in groups if len(group) > 1]


def _find_spans_by_stillness(timeline: RecordingTimeline, settings: CaptureSettings) -> list[tuple[float, float]]:
    """Where no fast sensor measures a change for as long as the slowest needs for one full measurement."""
    fast = [times for times in timeline.sensors.values() if times.period <= settings.max_motion_period]
    if not fast:
        return []
    spans = [find_still_spans(times.stamps, times.activity, settings.motion) for times in fast]
    common = spans[0]
    for other in spans[1:]:
        common = _intersect(common, other)
    periods = [times.period for times in timeline.sensors.values() if np.isfinite(times.period)]
    shortest = max(settings.min_hold, *periods)
    return [(float(a), float(b)) for a, b in common if b - a >= shortest]


def _intersect(a: Array, b: Array) -> Array:
    """Overlaps of two sets of disjoint, ordered spans (N, 2) and (M, 2)."""
    start = np.maximum(a[:, None, 0], b[None, :, 0])
    end = np.minimum(a[:, None, 1], b[None, :, 1])
    overlap = start < end
    return np.stack([start[overlap], end[overlap]], axis=1)


def _select_stamps(times: SensorTimes, start: float, end: float, snapshots: bool) -> Array:
    """Stamps of the messages that were measured entirely between start and end.

    Where messages do not state how long they took, their stamp may be of the first or of the last point: only a
    message with another one before it in the hold is then used (MSG-Cal's second measurement).
    """
    if snapshots:
        return times.stamps[(times.stamps >= start) & (times.stamps <= end)]
    inside = times.stamps[(times.stamps >= start) & (times.stamps + times.duration <= end + 1e-6)]
    return inside if times.duration > 0 else inside[1:]

"""The times in which no sensor's view changes."""

import numpy as np

from calgraph.config.settings import CaptureSettings
from calgraph.geometry import Array
from calgraph.rig.captures.motion_detection import find_still_spans
from calgraph.rig.captures.timeline import RecordingTimeline

# Longest period of a sensor, s, whose messages show motion: slower ones miss moves between two holds.
MAX_MOTION_PERIOD = 0.5


def find_rests(timeline: RecordingTimeline, settings: CaptureSettings) -> list[tuple[float, float]]:
    """Where no fast sensor measures a change for as long as the slowest needs for one full measurement.

    Args:
        timeline: with the activity of the sensors.
        settings: of the search.

    Returns:
        Start and end of each rest, s, in order of time.
    """
    fast = [times for times in timeline.sensors.values() if times.period <= MAX_MOTION_PERIOD]
    if not fast:
        return []
    spans = [find_still_spans(times.stamps, times.activity) for times in fast]
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

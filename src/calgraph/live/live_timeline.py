"""When the sensors measured so far: the timeline of a recording that grows."""

from array import array
from bisect import bisect_left, insort
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import numpy as np

from calgraph.geometry import Array
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.sensors import PointCloud, RecordedMessage

# The period of a sensor and its rate are those of its last messages: drivers change them, and connections break.
_RECENT = 21


@dataclass
class _GrowingTimes:
    """When one sensor measured so far."""

    stamps: "array[float]" = field(default_factory=lambda: array("d"))
    """Ascending, s."""
    arrivals: "array[float]" = field(default_factory=lambda: array("d"))
    """Of the last messages, s."""
    duration: float = 0.0
    frame_id: str = ""
    message_type: str = ""
    measured: bool = False
    """Whether the duration is known."""
    period: float = float("inf")
    """Of the last messages, s."""
    latest: float | None = None
    """Stamp of the message that arrived last, s: one damaged stamp may be later than all others."""
    malformed: int = 0
    """Number of messages that could not be used."""
    problem: str = ""
    """Why the last of them could not."""

    def measure_period(self) -> None:
        """Measures the period of the last messages."""
        recent = self.stamps[-_RECENT:]
        if len(recent) > 1:
            self.period = median(b - a for a, b in pairwise(recent))


class LiveTimeline:
    """The stamps of all sensors, and what their first messages state.

    What :func:`build_timeline` finds in the recording of the same messages is the same.

    Args:
        sensors: their names.
    """

    def __init__(self, sensors: Collection[str]) -> None:
        self._times = {name: _GrowingTimes() for name in sensors}
        self.start: float | None = None
        """The first arrival of a message, s; windows in rig.yaml count from here. None before it."""
        self.latest_arrival = 0.0
        """Of all messages, s."""

    def restore(self, timeline: RecordingTimeline, end: float) -> None:
        """Begins with what was recorded before, until the arrival ``end``, s."""
        self.start, self.latest_arrival = timeline.start, end
        for name, times in timeline.sensors.items():
            known = bool(times.message_type)
            stamps = array("d", times.stamps.tolist())
            self._times[name] = _GrowingTimes(
                stamps,
                array("d"),
                times.duration,
                times.frame_id,
                times.message_type,
                known,
                latest=stamps[-1] if stamps else None,
            )
            self._times[name].measure_period()

    def note_arrival(self, arrival: float) -> None:
        """Notes that a message of any topic arrived, s."""
        self.start = arrival if self.start is None else min(self.start, arrival)
        self.latest_arrival = max(self.latest_arrival, arrival)

    def add(self, name: str, record: RecordedMessage) -> None:
        """Adds a message of a sensor; the first one with content is decoded.

        Raises:
            RecordingError: the content of the first message is unusable; its stamp is kept.
        """
        times = self._times[name]
        if not times.stamps or record.stamp >= times.stamps[-1]:
            times.stamps.append(record.stamp)
        else:
            insort(times.stamps, record.stamp)
        times.latest = record.stamp
        times.arrivals.append(record.arrival)
        if len(times.arrivals) > 2 * _RECENT:
            del times.arrivals[:-_RECENT]
        times.measure_period()
        if not times.measured:
            message = record.decode()
            times.duration = getattr(message, "duration", 0.0)
            times.frame_id = getattr(message, "frame_id", "")
            times.message_type = type(message).__name__
            # Clouds without points, of lost packets, have no duration.
            times.measured = not isinstance(message, PointCloud) or not message.is_empty

    def note_malformed(self, name: str, problem: str) -> None:
        """Counts a message of a sensor that cannot be used."""
        self._times[name].malformed += 1
        self._times[name].problem = problem

    def describe_malformed(self, name: str) -> str:
        """How many messages of a sensor could not be used, and why the last one; empty if there are none."""
        times = self._times[name]
        return f"{times.malformed} unusable messages: {times.problem}" if times.malformed else ""

    def message_type(self, name: str) -> str:
        """Type of the sensor's messages; empty before the first."""
        return self._times[name].message_type

    def last_stamp(self, name: str) -> float | None:
        """Stamp of the sensor's message that arrived last, s; None before the first."""
        return self._times[name].latest

    def age(self, name: str) -> float | None:
        """Time from the last arrival of the sensor's messages to the last of all, s; None before the first."""
        arrivals = self._times[name].arrivals
        return max(self.latest_arrival - arrivals[-1], 0.0) if arrivals else None

    def latency(self, name: str) -> float | None:
        """Time from the end of the sensor's last measurement to its arrival, s; None before the first message."""
        times = self._times[name]
        if times.latest is None or not times.arrivals:
            return None
        return times.arrivals[-1] - times.latest - times.duration

    def delay(self, name: str) -> float | None:
        """Median of the sensor's last stamps minus arrivals, s; None before the first message."""
        times = self._times[name]
        pairs = list(zip(reversed(times.stamps), reversed(times.arrivals), strict=False))[:_RECENT]
        return median(stamp - arrival for stamp, arrival in pairs) if pairs else None

    def period(self, name: str) -> float:
        """Median time between the sensor's last measurements, s; infinite for fewer than two."""
        return self._times[name].period

    def rate(self, name: str) -> float:
        """Messages per second of late."""
        arrivals = self._times[name].arrivals[-_RECENT:]
        duration = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        return (len(arrivals) - 1) / duration if duration > 0 else 0.0

    def duration(self, name: str) -> float:
        """Duration of one measurement, s; 0 where the messages do not state it."""
        return self._times[name].duration

    def stamps_from(self, name: str, start: float) -> Array:
        """(N,) stamps of the sensor's measurements at ``start`` or later, s."""
        stamps = self._times[name].stamps
        return np.array(stamps[bisect_left(stamps, start) :])

    def snapshot(self, triggers: Sequence[float], start: float = -np.inf) -> RecordingTimeline:
        """The timeline so far, without activity.

        Args:
            triggers: stamps of the triggers, s.
            start: measurements before it are left out, s.
        """
        sensors = {}
        for name, times in self._times.items():
            stamps = self.stamps_from(name, start)
            activity = np.zeros(len(stamps))
            sensors[name] = SensorTimes(stamps, times.duration, activity, times.frame_id, times.message_type)
        return RecordingTimeline(self.start or 0.0, sensors, np.unique(np.array(triggers, dtype=np.float64)))

"""When the sensors measured so far: the timeline of a recording that grows."""

from array import array
from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.recording.takes import shift_record
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.captures.validate_recording import is_message_of_kind
from calgraph.sensors import PointCloud, RecordedMessage

# The period of a sensor and its rate are those of its last messages: drivers change them, and connections break.
_RECENT = 21
# Maximum difference of a sensor's clock from the others, s, that is one of latencies: networks and drivers take
# some tenths.
_MAX_CLOCK_DIFFERENCE = 1.0
# Time without messages, s, after which a sensor is taken for silent; three periods of slow ones.
_SILENCE = 2.0


@dataclass
class GrowingTimes:
    """When one sensor measured so far."""

    stamps: "array[float]" = field(default_factory=lambda: array("d"))
    """Ascending, s."""
    arrivals: "array[float]" = field(default_factory=lambda: array("d"))
    """Of the last messages, s."""
    duration: float = 0.0
    """Of one measurement, s; 0 where the messages do not state it."""
    frame_id: str = ""
    message_type: str = ""
    """Empty before the first message with content."""
    measured: bool = False
    """Whether the duration is known."""
    period: float = float("inf")
    """Median time between the last measurements, s; infinite for fewer than two."""
    latest: float | None = None
    """Stamp of the message that arrived last, s: one damaged stamp may be later than all others."""
    malformed: int = 0
    """Number of messages that could not be used."""
    problem: str = ""
    """Why the last of them could not."""

    @property
    def rate(self) -> float:
        """Messages per second of late."""
        arrivals = self.arrivals[-_RECENT:]
        duration = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        return (len(arrivals) - 1) / duration if duration > 0 else 0.0

    @property
    def ahead(self) -> float | None:
        """Median of the ends of the last measurements minus their arrivals, s; None before the first message."""
        pairs = list(zip(reversed(self.stamps), reversed(self.arrivals), strict=False))[:_RECENT]
        return median(stamp - arrival for stamp, arrival in pairs) + self.duration if pairs else None

    def stamps_from(self, start: float) -> Array:
        """(N,) stamps of the measurements at ``start`` or later, s."""
        return np.array(self.stamps[bisect_left(self.stamps, start) :])

    def note_malformed(self, problem: str) -> None:
        """Counts a message that cannot be used."""
        self.malformed, self.problem = self.malformed + 1, problem

    def describe_malformed(self) -> str:
        """How many messages could not be used, and why the last one; empty if there are none."""
        return f"{self.malformed} unusable messages: {self.problem}" if self.malformed else ""


class LiveTimeline:
    """The stamps of all sensors, and what their first messages state.

    What :func:`build_timeline` finds in the recording of the same messages is the same.
    """

    def __init__(self, rig: Rig) -> None:
        # Offsets that are to be estimated are known when the recording is calibrated.
        stated = {name: spec.clock_offset for name, spec in rig.sensors.items()}
        self.clock_offsets = {name: one if isinstance(one, float) else 0.0 for name, one in stated.items()}
        """By sensor, s."""
        self._kinds = {name: spec.kind for name, spec in rig.sensors.items()}
        # Networks and drives estimate clock offsets always, and rig.yaml does not state them.
        self._clock_remedy = "" if rig.is_network or rig.is_drive else ": state its clock_offset"
        self.sensors = {name: GrowingTimes() for name in rig.sensors}
        """By name."""
        self.start: float | None = None
        """The first arrival of a message, s; windows in rig.yaml count from here. None before it."""
        self.latest_arrival = 0.0
        """Of all messages, s."""

    def note_arrival(self, arrival: float) -> None:
        """Notes that a message of any topic arrived, s."""
        self.start = arrival if self.start is None else min(self.start, arrival)
        self.latest_arrival = max(self.latest_arrival, arrival)

    def correct(self, name: str, record: RecordedMessage) -> RecordedMessage:
        """A message of a sensor with a stamp by the clock of the others, as far as rig.yaml states the offset."""
        return shift_record(record, -self.clock_offsets[name], 0.0)

    def add(self, name: str, record: RecordedMessage) -> None:
        """Adds a message of a sensor; the first one with content is decoded.

        Raises:
            RecordingError: the content of the first message is unusable; its stamp is kept.
        """
        times = self.sensors[name]
        if not times.stamps or record.stamp >= times.stamps[-1]:
            times.stamps.append(record.stamp)
        else:
            insort(times.stamps, record.stamp)
        times.latest = record.stamp
        times.arrivals.append(record.arrival)
        if len(times.arrivals) > 2 * _RECENT:
            del times.arrivals[:-_RECENT]
        if len(times.stamps) > 1:
            times.period = median(b - a for a, b in pairwise(times.stamps[-_RECENT:]))
        if not times.measured:
            message = record.decode()
            times.duration = getattr(message, "duration", 0.0)
            times.frame_id = getattr(message, "frame_id", "")
            times.message_type = type(message).__name__
            # Clouds without points, of lost packets, have no duration.
            times.measured = not isinstance(message, PointCloud) or not message.is_empty

    def age(self, name: str) -> float | None:
        """Time from the last arrival of the sensor's messages to the last of all, s; None before the first."""
        arrivals = self.sensors[name].arrivals
        return max(self.latest_arrival - arrivals[-1], 0.0) if arrivals else None

    def find_problems(self) -> dict[str, str]:
        """By sensor whose messages are of no use now, why: a predicate."""
        clocks = self.find_wrong_clocks()
        found = {name: self._find_problem(name, kind, clocks.get(name, 0.0)) for name, kind in self._kinds.items()}
        return {name: problem for name, problem in found.items() if problem}

    def _find_problem(self, name: str, kind: str, ahead: float) -> str:
        age, message_type = self.age(name), self.sensors[name].message_type
        if age is None:
            return "sends no messages"
        if self.is_silent(name):
            return f"has sent no message for {age:.0f} s"
        if not is_message_of_kind(message_type, kind):
            return f"sends {message_type} messages, and its kind is {kind}"
        if ahead:
            side = "early" if ahead > 0 else "late"
            return f"has a clock that is {abs(ahead):.1f} s {side}{self._clock_remedy}"
        return ""

    def is_silent(self, name: str) -> bool:
        """Whether a sensor has sent messages, and does not any more."""
        age, times = self.age(name), self.sensors[name]
        slow = max(times.period if times.period < float("inf") else 0.0, times.duration)
        return age is not None and age > max(_SILENCE, 3 * slow)

    def find_wrong_clocks(self) -> dict[str, float]:
        """By sensor, by how much its clock is ahead of those of the others, s, where that is much."""
        ahead = {name: one for name, times in self.sensors.items() if (one := times.ahead) is not None}
        differences = {}
        for name, own in ahead.items():
            # Which one of two is right is unknown.
            others = [one for other, one in ahead.items() if other != name or len(ahead) > 2]
            differences[name] = own - median(others) if others else 0.0
        return {name: one for name, one in differences.items() if abs(one) > _MAX_CLOCK_DIFFERENCE}

    def snapshot(self, triggers: Sequence[float], start: float = -np.inf) -> RecordingTimeline:
        """The timeline so far, without activity.

        Args:
            triggers: stamps of the triggers, s.
            start: measurements before it are left out, s.
        """
        sensors = {}
        for name, times in self.sensors.items():
            stamps = times.stamps_from(start)
            activity = np.zeros(len(stamps))
            sensors[name] = SensorTimes(stamps, times.duration, activity, times.frame_id, times.message_type)
        return RecordingTimeline(self.start or 0.0, sensors, np.unique(np.array(triggers, dtype=np.float64)))

"""When each sensor measured: all that the search for captures keeps of a whole recording."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.geometry import Array
from calgraph.rig.captures.motion_detection import JITTER, ActivityMeter
from calgraph.sensors import PointCloud, RecordedMessage

# Longest period of a sensor, s, whose messages show motion: slower ones miss moves between two holds.
MAX_MOTION_PERIOD = 0.5


@dataclass(frozen=True, eq=False)
class SensorTimes:
    """When one sensor measured."""

    stamps: Array
    """(N,) header stamps in ascending order, s."""
    duration: float
    """Duration of one measurement, s; 0 for images, and where the messages do not state it."""
    activity: Array
    """(N,) share of the view that changed since an earlier message; 0 where it was not measured, NaN of messages
    without content."""
    frame_id: str = ""
    """The frame its messages state."""
    message_type: str = ""
    """Type of its messages: ``Image``, ``LaserScan``, ``PointCloud``, ...; empty where there are none."""
    arrivals: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) when the messages of these stamps arrived, s; empty where they are not of a recording."""
    baseline: float = 0.0
    """Longest time back to the messages that activity is measured against, s: to the one before, if it is more."""

    @property
    def period(self) -> float:
        """Typical time between messages, s; infinite for a single one."""
        return float(np.median(np.diff(self.stamps))) if len(self.stamps) > 1 else float("inf")

    def with_content(self) -> "SensorTimes":
        """The stamps and activities of messages with content alone."""
        kept = ~np.isnan(self.activity)
        return replace(self, stamps=self.stamps[kept], activity=self.activity[kept], arrivals=np.zeros(0))

    @property
    def reach(self) -> float:
        """Typical time back to the message that activity is measured against, s: a multiple of the period."""
        periods = max(np.floor(self.baseline / self.period + JITTER), 1) if self.period > 0 else 1
        return float(periods * self.period)


@dataclass(frozen=True, eq=False)
class RecordingTimeline:
    """When all sensors measured, and when captures were triggered."""

    start: float
    """Start of the recording, s: windows in rig.yaml count from here."""
    sensors: Mapping[str, SensorTimes]
    triggers: Array
    """(T,) s, ascending."""
    poses: Sequence[tuple[float, float]] = ()
    """First and last stamp, s, of every recording, where each is of one pose of the board."""


def build_timeline(
    records: Iterable[RecordedMessage],
    start: float,
    topics: Mapping[str, str],
    trigger: str | None,
    *,
    meters: Mapping[str, ActivityMeter] | None = None,
    progress: Callable[[float], None] | None = None,
) -> RecordingTimeline:
    """Reads a recording once and collects when each sensor measured.

    Args:
        records: all records of the sensors and of the trigger, streamed.
        start: start of the recording, s.
        topics: topic by sensor.
        trigger: topic of the triggers, if there is one.
        meters: by sensor, to measure what changed from message to message (decodes every message).
        progress: called with the arrival time of records.

    Returns:
        The timeline, with an entry for every sensor, empty for those without messages.
    """
    by_topic = {topic: name for name, topic in topics.items()}
    stamps: dict[str, list[float]] = {name: [] for name in topics}
    arrivals: dict[str, list[float]] = {name: [] for name in topics}
    activity: dict[str, list[float]] = {name: [] for name in topics}
    first: dict[str, tuple[float, str, str]] = {}
    measured: set[str] = set()
    triggers: list[float] = []
    for record in records:
        if progress:
            progress(record.arrival)
        if record.topic == trigger:
            triggers.append(record.stamp)
        name = by_topic.get(record.topic)
        if name is None:
            continue
        stamps[name].append(record.stamp)
        arrivals[name].append(record.arrival)
        meter = (meters or {}).get(name)
        # The duration is taken from one message: decoding all of them would take as long as the detection. Clouds
        # without points, of lost packets, have none.
        message = record.decode() if meter or name not in measured else None
        if message and name not in measured:
            duration = getattr(message, "duration", 0.0)
            first[name] = duration, getattr(message, "frame_id", ""), type(message).__name__
            if not isinstance(message, PointCloud) or not message.is_empty:
                measured.add(name)
        activity[name].append(meter.measure_change(message) if meter and message else 0.0)
    sensors = {}
    for name in topics:
        order = np.argsort(stamps[name], kind="stable")
        of_stamps, changes, arrived = (np.array(one[name])[order] for one in (stamps, activity, arrivals))
        duration, frame_id, message_type = first.get(name, (0.0, "", ""))
        baseline = meters[name].baseline if meters else 0.0
        sensors[name] = SensorTimes(of_stamps, duration, changes, frame_id, message_type, arrived, baseline)
    return RecordingTimeline(start, sensors, np.unique(np.array(triggers)))

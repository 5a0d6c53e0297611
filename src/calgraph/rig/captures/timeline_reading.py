"""Reading of a recording's timeline; what an earlier run read of a topic is taken from the cache."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.progress import Progress
from calgraph.recording import PoseRecordings, Recording, RecordingCache, RecordingReference
from calgraph.recording.input_checks import MAX_INTRINSICS_CHANGE, InputMonitor, TopicObservations
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.hold_messages import StoredMessages, count_parts, read_part, select_messages
from calgraph.rig.captures.motion_detection import (
    BASELINE,
    ActivityBlock,
    ActivityMeter,
    BlockMeter,
    measure_block,
)
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes, build_timeline
from calgraph.rig.kinds import RIG_KINDS
from calgraph.sensors import Message

_TOPIC, _ACTIVITY = "topic/3", "activity/3"
OnArrival = Callable[[float], None]
"""Called with the arrival time of records, s."""


def read_rig_timeline(
    rig: Rig,
    recording: Recording,
    monitor: InputMonitor,
    cache: RecordingCache,
    engine: Engine,
    progress: Progress,
    *,
    active: bool = False,
) -> RecordingTimeline:
    """The stamps of every sensor's messages and, where it matters, how much its view changed at each.

    With ``active``, it matters in any case: clocks are found from it.
    """

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = read_timeline(rig, recording, monitor, cache, reading)
    if isinstance(recording, PoseRecordings):
        timeline = replace(timeline, poses=recording.poses)
    rests_are_known = bool(rig.capture.trigger) and not active
    if rests_are_known or recognize_mode(timeline, rig.capture, rig.settings.captures).mode == "snapshots":
        return timeline
    return measure_activity(timeline, rig, recording, cache, reading, engine)


@dataclass(frozen=True, eq=False)
class _TopicContent:
    """What one pass over the messages of a topic yields."""

    times: SensorTimes
    """Of a sensor."""
    triggers: Array
    """(T,) stamps of a trigger, s."""
    observations: TopicObservations


# Of topics that are no sensors'.
_TOPIC_TYPES = (_TopicContent, SensorTimes, TopicObservations)
_NOTHING_MEASURED = SensorTimes(np.zeros(0), 0.0, np.zeros(0))
_NOTHING_OBSERVED = TopicObservations(np.zeros(0, np.int64), {})


def read_timeline(
    rig: Rig, recording: Recording, monitor: InputMonitor, cache: RecordingCache, progress: OnArrival
) -> RecordingTimeline:
    """Reads when the sensors measured and when captures were triggered, without activity.

    Args:
        rig: the rig.
        recording: to read.
        monitor: observes the messages, or takes what it observed in an earlier run.
        cache: has the topics that earlier runs read, and gets the others.
        progress: called while messages are read.
    """
    inputs = _list_inputs(rig, monitor)
    known = {
        topic: content
        for topic, given in inputs.items()
        if (content := cache.read(recording, _TOPIC, given, _TOPIC_TYPES)) is not None
    }
    for topic, content in known.items():
        if topic in monitor.topics:
            monitor.restore(topic, content.observations)
    if known:
        recording.records(list(inputs))  # refuses topics that do not fit together
    unread = [topic for topic in inputs if topic not in known]
    if unread:
        sensors = {name: topic for name, topic in rig.topics.items() if topic in unread}
        trigger = rig.capture.trigger if rig.capture.trigger in unread else None
        records = monitor.observe(recording.records(unread))
        read = build_timeline(records, recording.start, sensors, trigger, progress=progress)
        for topic in unread:
            known[topic] = _TopicContent(
                next((read.sensors[name] for name in sensors if sensors[name] == topic), _NOTHING_MEASURED),
                read.triggers if topic == trigger else np.zeros(0),
                monitor.observations(topic) if topic in monitor.topics else _NOTHING_OBSERVED,
            )
            cache.write(recording, _TOPIC, inputs[topic], known[topic])
    by_sensor = {name: known[topic].times for name, topic in rig.topics.items()}
    triggers = known[rig.capture.trigger].triggers if rig.capture.trigger else np.zeros(0)
    return RecordingTimeline(recording.start, by_sensor, triggers)


def measure_activity(
    timeline: RecordingTimeline,
    rig: Rig,
    recording: Recording,
    cache: RecordingCache,
    progress: OnArrival,
    engine: Engine = THIS_PROCESS,
) -> RecordingTimeline:
    """The timeline with how much the view of every sensor changed; decodes all messages that are not in the cache.

    Arguments are those of :func:`read_timeline`, and the engine, which does not change the result.
    """
    inputs = {name: {"topic": topic} for name, topic in rig.topics.items()}
    activity = {
        name: found
        for name, given in inputs.items()
        if (found := cache.read(recording, _ACTIVITY, given)) is not None
    }
    unread = {name: topic for name, topic in rig.topics.items() if name not in activity}
    if unread:
        stored = select_messages(rig, recording, timeline, engine)
        if stored is None:
            activity |= _measure_sent(rig, recording, unread, progress, engine)
        else:
            activity |= _measure_stored(rig, stored, unread, progress, engine)
        for name in unread:
            cache.write(recording, _ACTIVITY, inputs[name], activity[name])
    sensors = {
        name: replace(times, activity=activity[name], baseline=BASELINE)
        for name, times in timeline.sensors.items()
    }
    return replace(timeline, sensors=sensors)


def _measure_sent(
    rig: Rig, recording: Recording, topics: Mapping[str, str], progress: OnArrival, engine: Engine
) -> dict[str, Array]:
    """Changes (N,) of each sensor's messages in the order of their stamps, from calls to which they are sent."""
    names = {topic: name for name, topic in topics.items()}
    stamps: dict[str, list[float]] = {name: [] for name in topics}
    order: deque[str] = deque()

    def gather_blocks() -> Iterator[tuple[list[Callable[[], Message]]]]:
        waiting: dict[str, list[Callable[[], Message]]] = {name: [] for name in topics}
        for record in recording.records(topics.values()):
            progress(record.arrival)
            name = names[record.topic]
            stamps[name].append(record.stamp)
            waiting[name].append(record.decode)
            if len(waiting[name]) == RIG_KINDS[rig.sensors[name].kind].messages_per_block:
                order.append(name)
                yield (waiting[name],)
                waiting[name] = []
        for name, decoders in waiting.items():
            order.append(name)
            yield (decoders,)

    meters = {name: ActivityMeter(BASELINE) for name in topics}
    changes: dict[str, list[float]] = {name: [] for name in topics}
    for block in engine.map(measure_block, gather_blocks()):
        name = order.popleft()
        changes[name] += meters[name].join(block)
    return {name: _sort_changes(changes[name], stamps[name]) for name in topics}


def _measure_stored(
    rig: Rig, messages: StoredMessages, topics: Mapping[str, str], progress: OnArrival, engine: Engine
) -> dict[str, Array]:
    """The same, from calls that read the messages themselves."""
    meters = {name: ActivityMeter(BASELINE) for name in topics}
    stamps: dict[str, list[float]] = {name: [] for name in topics}
    changes: dict[str, list[float]] = {name: [] for name in topics}
    parts = _divide_time(rig, messages.timeline, topics, count_parts(engine))
    given = Kept.of((messages.reference, topics))
    blocks_of_parts = engine.map(_measure_part, [(given, *part) for part in parts])
    for (_, last), blocks in zip(parts, blocks_of_parts, strict=True):
        progress(last)
        for name, (of_block, block) in blocks.items():
            stamps[name] += of_block
            changes[name] += meters[name].join(block)
    return {name: _sort_changes(changes[name], stamps[name]) for name in topics}


def _divide_time(
    rig: Rig, timeline: RecordingTimeline, topics: Mapping[str, str], count: int
) -> list[tuple[float, float]]:
    """At most ``count`` intervals of nearly equal work: when their first and their last message arrived, s."""
    arrivals = [timeline.sensors[name].arrivals for name in topics]
    work = [
        np.full(len(one), 1 / RIG_KINDS[rig.sensors[name].kind].messages_per_block)
        for name, one in zip(topics, arrivals, strict=True)
    ]
    times, of_time = np.unique(np.concatenate(arrivals), return_inverse=True)
    if not len(times):
        return []
    done = np.cumsum(np.bincount(of_time, np.concatenate(work)))
    part = np.minimum((count * done / done[-1]).astype(int), count - 1)
    first = np.flatnonzero(np.diff(part, prepend=-1))
    last = np.append(first[1:], len(times)) - 1
    return list(zip(times[first].tolist(), times[last].tolist(), strict=True))


def _measure_part(
    shared: tuple[RecordingReference, Mapping[str, str]], first: float, last: float
) -> dict[str, tuple[list[float], ActivityBlock]]:
    """Stamps and changes by sensor, of the messages that arrived from ``first`` to ``last``, in this order."""
    reference, topics = shared
    names = {topic: name for name, topic in topics.items()}
    meters = {name: BlockMeter() for name in topics}
    stamps: dict[str, list[float]] = {name: [] for name in topics}
    with reference.open() as recording:
        for record in read_part(recording, topics.values(), first, last):
            stamps[names[record.topic]].append(record.stamp)
            meters[names[record.topic]].add(record.decode())
    return {name: (stamps[name], meter.block()) for name, meter in meters.items()}


def _sort_changes(changes: list[float], stamps: list[float]) -> Array:
    """Changes (N,) in the order of stamps, from those in the order of arrival."""
    return np.array(changes)[np.argsort(stamps, kind="stable")]


def _list_inputs(rig: Rig, monitor: InputMonitor) -> dict[str, dict[str, Any]]:
    """By topic, what its content depends on besides the recording."""
    inputs: dict[str, dict[str, Any]] = {
        topic: {"topic": topic, "role": "sensor"} for topic in rig.topics.values()
    }
    limit = MAX_INTRINSICS_CHANGE
    for topic in monitor.camera_info_topics:
        inputs.setdefault(topic, {"topic": topic, "role": "intrinsics", "max_change": limit})
    if rig.capture.trigger:
        inputs.setdefault(rig.capture.trigger, {"topic": rig.capture.trigger, "role": "trigger"})
    return inputs

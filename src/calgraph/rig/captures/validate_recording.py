"""Checks that a recording fits a rig, before any detection: messages, stamps, trigger, windows, intrinsics."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.recording import TopicInfo
from calgraph.recording.file_names import describe_unmatched_numbers, find_pose_numbers
from calgraph.result.finding import Finding
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS

# Of kinds that send the same messages the first one is named.
_KIND_OF_MESSAGE = {message.__name__: kind.name for kind in reversed(KINDS.values()) for message in kind.messages}


def check_timeline(rig: Rig, timeline: RecordingTimeline, end: float) -> None:
    """Checks the messages of a recording, which ends at ``end``, s, against its rig.

    Raises:
        InputError: no sensor has a message, a sensor's messages are of another kind, their stamps stand still or
            are of another time than the other sensors', the trigger is a sensor's topic, or the background window
            lies after the recording.
    """
    if not any(len(times.stamps) for times in timeline.sensors.values()):
        topics = ", ".join(spec.topic for spec in rig.sensors.values())
        raise InputError(
            f"the recording holds no message of any sensor ({topics}): were the drivers running while it was "
            "recorded? `calgraph inspect` lists what it contains"
        )
    window, length = rig.capture.background, end - timeline.start
    if window and window[0] >= length:
        raise InputError(
            f"capture.background: [{window[0]:g}, {window[1]:g}] s lies after the end of the recording, which is "
            f"{length:.1f} s long"
        )
    for name, spec in rig.sensors.items():
        if spec.topic == rig.capture.trigger:
            raise InputError(
                f"capture.trigger: {spec.topic} is the topic of the sensor {name}, not one that marks captures; "
                "leave the trigger out to find the holds from the data"
            )
    for name in rig.sensors:
        _check_messages(name, rig, timeline)
        _check_stamps(name, timeline, rig.settings.captures.max_snapshot_gap)
    _check_trigger_stamps(rig, timeline)


def check_pose_numbers(rig: Rig, timeline: RecordingTimeline, topics: Iterable[TopicInfo]) -> None:
    """Checks that files which are numbered by poses belong to poses of other sensors.

    Raises:
        InputError: no file of a sensor has the number of another one's.
    """
    numbered = {topic.name for topic in topics if topic.time_base == "pose"}
    numbers = {
        name: find_pose_numbers(timeline.sensors[name].stamps)
        for name, topic in rig.topics.items()
        if topic in numbered
    }
    for name, reason in describe_unmatched_numbers(numbers).items():
        raise InputError(f"sensors.{name}: {reason}")


def is_message_of_kind(message_type: str, kind: str) -> bool:
    """Whether sensors of a kind send messages of this type; true of an empty type, before the first message."""
    return not message_type or message_type in _list_messages(kind)


def _list_messages(kind: str) -> tuple[str, ...]:
    """Names of the messages that sensors of a kind send."""
    return tuple(message.__name__ for message in KINDS[kind].messages)


def _check_trigger_stamps(rig: Rig, timeline: RecordingTimeline) -> None:
    stamps = np.concatenate([times.stamps for times in timeline.sensors.values()])
    triggers = timeline.triggers
    if len(triggers) and (triggers[0] > stamps.max() or triggers[-1] < stamps.min()):
        raise InputError(
            f"capture.trigger: the stamps of {rig.capture.trigger} run from {triggers[0]:.3f} to "
            f"{triggers[-1]:.3f} s, those of the sensors from {stamps.min():.3f} to {stamps.max():.3f} s: "
            "their clocks differ, and arrivals do not show by how much; leave the trigger out to find the holds "
            "from the data"
        )


def _check_messages(name: str, rig: Rig, timeline: RecordingTimeline) -> None:
    spec, sent = rig.sensors[name], timeline.sensors[name].message_type
    if not is_message_of_kind(sent, spec.kind):
        sender = f"; a {_KIND_OF_MESSAGE[sent]} sends those" if sent in _KIND_OF_MESSAGE else ""
        raise InputError(
            f"sensors.{name}.topic: {spec.topic} has {sent} messages{sender}, but its kind {spec.kind} needs "
            f"{' or '.join(_list_messages(spec.kind))}"
        )


def _check_stamps(name: str, timeline: RecordingTimeline, max_gap: float) -> None:
    """Checks the stamps of a sensor; those of one pose may lie ``max_gap``, s, apart."""
    stamps = timeline.sensors[name].stamps
    if len(stamps) > 1 and stamps[0] == stamps[-1]:
        raise InputError(
            f"sensors.{name}: all its {len(stamps)} messages have the header stamp {stamps[0]:.3f} s; have its "
            "driver stamp them, or leave the sensor out"
        )
    others = [times.stamps for other, times in timeline.sensors.items() if other != name]
    other_stamps = np.concatenate([*others, timeline.triggers])
    if not len(stamps) or not len(other_stamps):
        return
    first, last = other_stamps.min(), other_stamps.max()
    if first - stamps[-1] > max_gap or stamps[0] - last > max_gap:
        raise InputError(
            f"sensors.{name}: its header stamps run from {stamps[0]:.3f} to {stamps[-1]:.3f} s, those of the "
            f"other sensors and triggers from {first:.3f} to {last:.3f} s: their clocks differ, and neither "
            "arrivals nor views show by how much; state the clock_offset of each sensor in seconds, or set the "
            "clocks, move the board at irregular times, and record again"
        )


# Maximum relative difference of fx and fy without a remark: pixels are square within 1 %, and those of analog
# cameras within 10 %.
_MAX_FOCAL_DIFFERENCE = 0.1
# Maximum distance of a principal point from the middle of the image, as a share of its size, without a remark:
# lenses are mounted within 5 %; K of half the resolution is off by 25 %.
_MAX_PRINCIPAL_POINT_OFFSET = 0.15


def check_intrinsics(cameras: Mapping[str, CameraModel]) -> Iterator[Finding]:
    """Reports intrinsics in another order than fx, fy, cx, cy, or of another image size."""
    for name, camera in cameras.items():
        fx, fy = camera.focal
        difference = abs(fx / fy - 1)
        if difference > _MAX_FOCAL_DIFFERENCE:
            yield Finding(
                f"fx and fy of {name} differ by {100 * difference:.0f} %, those of usual lenses do not: "
                "check that K is fx, fy, cx, cy"
            )
        size = (camera.width, camera.height)
        offset = np.abs((camera.principal_point + 0.5) / size - 0.5).max()
        if offset > _MAX_PRINCIPAL_POINT_OFFSET:
            yield Finding(
                f"the principal point of {name} is {100 * offset:.0f} % of the image's size away from its middle: "
                f"check that K belongs to images of {size[0]} x {size[1]} pixels"
            )


def check_background(rig: Rig, timeline: RecordingTimeline) -> Iterator[Finding]:
    """Reports a background window that contains triggers, at which the board was in view."""
    window = rig.capture.background
    if window is None:
        return
    times = timeline.triggers - timeline.start
    covered = int(np.sum((times >= window[0]) & (times <= window[1])))
    if covered:
        yield Finding(
            f"capture.background [{window[0]:g}, {window[1]:g}] contains {covered} of {len(times)} messages of "
            f"{rig.capture.trigger}, whose captures are not used: it must end before the board is in view"
        )

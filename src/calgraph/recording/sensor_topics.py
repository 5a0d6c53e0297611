"""Checks of the topics of sensors before they are read at length: types that are read, and the unit of lengths."""

import re
from collections import Counter
from collections.abc import Iterable
from itertools import islice

import numpy as np

from calgraph.config import Rig
from calgraph.errors import InputError, RecordingError
from calgraph.geometry import measure_lengths
from calgraph.recording.recording import Recording
from calgraph.sensors import LaserScan, Message, PointCloud
from calgraph.sensors.kinds import KINDS, MOTION_TYPES, SENSOR_TYPES, SensorKind

# How sensors' messages of types without a reader become others, by patterns of their names.
_REPLAY = "replay the recording through its driver, and record the PointCloud2 that it publishes"
_CONVERSIONS = {
    r"theora": ("republish it with `ros2 run image_transport republish`, and record Image or CompressedImage"),
    r"CompressedPointCloud": "republish it with point_cloud_transport, and record PointCloud2",
    r"ouster|hesai|pandar|rslidar|robosense|nebula|lslidar|innoviz|seyond|livox|velodyne|Packet|Scan": _REPLAY,
    r"DisparityImage|DepthCloud": "record the depth image, as a depth_camera",
}
# Median range, m, beyond which lengths are in millimetres: scanners measure up to 300 m, most of it nearer, and
# what is 0.3 m away has 300 mm.
_MAX_MEDIAN_RANGE = 300.0
# Messages of a scanner whose ranges are looked at; and those that are read for each to find as many with points.
_SAMPLED, _READ = 3, 100


def explain_unread(topic_type: str) -> str:
    """Why messages of a type cannot be those of a sensor, and what they can be converted to."""
    patterns = (
        advice for pattern, advice in _CONVERSIONS.items() if re.search(pattern, topic_type, re.IGNORECASE)
    )
    advice = next(patterns, "")
    return f"its messages of type {topic_type} are not read{': ' if advice else ''}{advice}"


def looks_like_sensor(topic_type: str) -> bool:
    """Whether a type without a reader is that of a known sensor."""
    return any(re.search(pattern, topic_type, re.IGNORECASE) for pattern in _CONVERSIONS)


def describe_unit(messages: Iterable[Message]) -> str:
    """That the lengths of a scanner's messages are in millimetres; empty if they are not."""
    medians = [float(np.median(ranges)) for message in messages if (ranges := _list_ranges(message)).size]
    if not medians or min(medians) < _MAX_MEDIAN_RANGE:
        return ""
    return (
        f"half of its points are farther than {min(medians):.0f} m: its lengths are in millimetres, and are "
        "needed in metres (REP 103): divide ranges or coordinates by 1000"
    )


def _list_ranges(message: Message) -> np.ndarray:
    if isinstance(message, LaserScan):
        return message.ranges[message.valid]
    return measure_lengths(message.points) if isinstance(message, PointCloud) else np.zeros(0)


def _check_motion_type(name: str, topic: str, topic_type: str, kind: SensorKind) -> None:
    """Raises InputError where messages of poses or turn rates are not those of the kind, or of other ones."""
    if topic_type not in kind.types:
        raise InputError(
            f"sensors.{name}.topic: {topic} has messages of type {topic_type}, but its kind {kind.name} needs "
            f"{', '.join(one for one in kind.types if '/' in one)}"
        )


def check_sensor_topics(rig: Rig, recording: Recording) -> None:
    """Checks that sensors' messages are of types that are read, and that scanners measure in metres.

    Raises:
        InputError: they are not; the message names type or unit, and what to do.
    """
    types = {topic.name: topic.type for topic in recording.topics}
    for name, topic in rig.topics.items():
        # Recordings in memory state no types.
        if types.get(topic) and types[topic] not in SENSOR_TYPES | MOTION_TYPES:
            raise InputError(f"sensors.{name}: {topic}: {explain_unread(types[topic])}")
        kind = KINDS[rig.sensors[name].kind]
        if types.get(topic) and (types[topic] in MOTION_TYPES or kind.detects == "motion"):
            _check_motion_type(name, topic, types[topic], kind)
    scanners = {
        spec.topic: name
        for name, spec in rig.sensors.items()
        if KINDS[spec.kind].measures_ranges and not KINDS[spec.kind].convert and spec.topic in types
    }
    found: dict[str, list[Message]] = {topic: [] for topic in scanners}
    waiting, read = set(scanners), Counter[str]()
    for record in islice(recording.records(list(scanners)), _READ * len(scanners)) if scanners else ():
        read[record.topic] += 1
        if record.topic not in waiting:
            continue
        try:
            message = record.decode()
        except RecordingError:
            continue  # what needs it states why
        if _list_ranges(message).size:
            found[record.topic].append(message)
        if len(found[record.topic]) == _SAMPLED or read[record.topic] == _READ:
            waiting.remove(record.topic)
        if not waiting:
            break
    for topic, messages in found.items():
        if problem := describe_unit(messages):
            raise InputError(f"sensors.{scanners[topic]}: {topic}: {problem}")

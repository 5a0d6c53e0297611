"""Inspection of a recording: its topics, their timing, and anomalies."""

from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.config import FoundTopic, Kind
from calgraph.errors import RecordingError
from calgraph.geometry import Array, estimate_spread
from calgraph.recording.bags import BagRecording
from calgraph.recording.camera_info import MAX_UNCALIBRATED
from calgraph.recording.clocks import Arrivals, find_differences, measure_duration
from calgraph.recording.file_names import describe_unmatched_numbers, find_pose_numbers
from calgraph.recording.recording import Recording, TopicInfo
from calgraph.recording.sensor_topics import describe_unit, explain_unread, looks_like_sensor
from calgraph.sensors import Message, RecordedMessage
from calgraph.sensors.kinds import KINDS, recognize_kind
from calgraph.sensors.kinds.sensor_kind import foxglove_types

_OTHER_KINDS: dict[str, Kind] = {
    **dict.fromkeys(("sensor_msgs/msg/CameraInfo", *foxglove_types("CameraCalibration")), "camera_info"),
    "sensor_msgs/msg/TimeReference": "event",
    "camera_info": "camera_info",
}
_EVENTS = "std_msgs/msg/"
_MAX_GAP_PERIODS = 4.0
"""Gaps longer than this many periods are reported."""
_MAX_DRIFT = 0.02
"""Drift of a clock against the recorder's over the recording above which it is reported, s."""


@dataclass(frozen=True)
class Timing:
    """The times of a topic's messages."""

    start: float
    """First stamp, s after the first arrival in the recording."""
    rate: float | None
    """One over the median period, Hz; None with fewer than two stamps."""
    jitter: float | None
    """Standard deviation of the period, s, without outliers (1.48 times the median deviation)."""
    longest_gap: float | None
    """Longest time between two stamps, s."""
    delay: tuple[float, float, float]
    """Smallest, median and largest arrival minus stamp, s."""


@dataclass(frozen=True)
class TopicReport:
    """One topic of a recording."""

    name: str
    type: str
    kind: Kind
    stated: int
    """Messages that the recording states to have."""
    count: int
    """Messages that it has."""
    frame_id: str = ""
    """Of the first message."""
    content: str = ""
    """Size of the first message, in words."""
    timing: Timing | None = None
    """None without messages, and of numbered files."""
    pose_numbers: tuple[int, int] | None = None
    """The first and the last, of numbered files."""
    findings: tuple[str, ...] = ()
    """Anomalies, in words."""


@dataclass(frozen=True)
class Inspection:
    """What is in a recording."""

    duration: float
    """From the first to the last arrival, s; 0 for numbered files."""
    topics: tuple[TopicReport, ...]
    """Sorted by name."""
    notices: tuple[str, ...] = ()
    """What is missing of it although it could be read, in words."""
    damage: str = ""
    """Why it could not be read to its end, or that it is empty; an empty text otherwise."""
    clock_offsets: Mapping[str, float] = field(default_factory=dict)
    """By topic whose clock differs for sure, the offset that a calibration subtracts from its stamps, s."""


@dataclass
class _TopicStatistics:
    """Statistics of a topic, accumulated while the recording is read."""

    stamps: "array[float]" = field(default_factory=lambda: array("d"))
    arrivals: "array[float]" = field(default_factory=lambda: array("d"))
    first: Message | None = None
    """That can be used."""
    unusable: int = 0
    """Messages before it, which were decoded."""
    problem: str = ""
    """Of the first of them."""


def find_topics(recording: Recording) -> tuple[FoundTopic, ...]:
    """The topics with what a draft of a rig.yaml needs to know; reads one message of each sensor."""
    return tuple(_summarize_topic(recording, topic) for topic in recording.topics)


def inspect_recording(recording: Recording, progress: Callable[[float], None]) -> Inspection:
    """Reads a recording once, as a stream, and decodes the first message of each sensor.

    Args:
        recording: open recording.
        progress: called with the fraction read, 0..1.
    """
    statistics = {topic.name: _TopicStatistics() for topic in recording.topics}
    damage = ""
    duration = recording.end - recording.start
    try:
        for record in recording.records():
            _add_record(statistics[record.topic], record)
            progress((record.arrival - recording.start) / max(duration, 1e-9))
    except RecordingError as error:
        damage = str(error)
    if not damage and not any(one.stamps for one in statistics.values()):
        damage = (
            f"{recording.path}: holds no message; was the recorder stopped before a driver published anything?"
        )
    numbers = {
        topic.name: find_pose_numbers(statistics[topic.name].stamps)
        for topic in recording.topics
        if topic.time_base == "pose" and _kind(topic.type, statistics[topic.name].first) in KINDS
    }
    unmatched = describe_unmatched_numbers(numbers)
    differences = find_differences(
        {
            topic.name: arrivals
            for topic in recording.topics
            if (arrivals := _list_arrivals(topic, statistics[topic.name])) is not None
        }
    )
    remarks = {name: f"its stamps {one.describe()}" for name, one in differences.items()} | unmatched
    reports = (_report(topic, statistics[topic.name], recording.start) for topic in recording.topics)
    return Inspection(
        0.0 if numbers else duration,
        tuple(
            replace(report, findings=(*report.findings, remarks[report.name]))
            if report.name in remarks
            else report
            for report in reports
        ),
        recording.notices if isinstance(recording, BagRecording) else (),
        damage,
        {name: one.offset for name, one in differences.items() if one.certain},
    )


def _list_arrivals(topic: TopicInfo, statistics: _TopicStatistics) -> Arrivals | None:
    """When the messages of a sensor or of what may be a trigger arrived; None of other topics."""
    kind = _kind(topic.type, statistics.first)
    duration = measure_duration(statistics.first) if statistics.first else 0.0
    arrivals = Arrivals(np.array(statistics.stamps), np.array(statistics.arrivals), duration)
    # Events without a header are stamped by the recorder.
    of_clock = kind in KINDS or (kind == "event" and not arrivals.are_stamps)
    return arrivals if of_clock and statistics.stamps and topic.time_base == "clock" else None


def _summarize_topic(recording: Recording, topic: TopicInfo) -> FoundTopic:
    statistics = _TopicStatistics()
    if _kind(topic.type) in (*KINDS, "camera_info"):
        for record in recording.records([topic.name]):
            _add_record(statistics, record)
            if statistics.first or statistics.unusable == MAX_UNCALIBRATED:
                break
    kind = _kind(topic.type, statistics.first)
    return FoundTopic(
        topic.name,
        topic.type,
        kind,
        topic.count,
        statistics.first.frame_id if statistics.first else "",
        _describe_problem(topic.type, kind, statistics),
        own_clock=topic.time_base == "start",
    )


def _describe_problem(topic_type: str, kind: Kind, statistics: _TopicStatistics) -> str:
    """Why a topic cannot be a sensor; empty if it can."""
    if kind == "other":
        return explain_unread(topic_type)
    return describe_unit([statistics.first]) if statistics.first else statistics.problem


def _kind(message_type: str, first: Message | None = None) -> Kind:
    """What a topic of this type can serve as, from its first message where that was read."""
    other: Kind = "event" if message_type.startswith(_EVENTS) else "other"
    return recognize_kind(message_type, first) or _OTHER_KINDS.get(message_type, other)


def _add_record(statistics: _TopicStatistics, record: RecordedMessage) -> None:
    if statistics.first is None and statistics.unusable < MAX_UNCALIBRATED:
        try:
            statistics.first = record.decode()
        except RecordingError as error:
            statistics.unusable += 1
            # The report already names the recording and the topic.
            problem = str(error).partition(": topic ")[2].partition(": ")[2] or str(error)
            statistics.problem = statistics.problem or problem
    statistics.stamps.append(record.stamp)
    statistics.arrivals.append(record.arrival)


def _report(topic: TopicInfo, statistics: _TopicStatistics, start: float) -> TopicReport:
    kind = _kind(topic.type, statistics.first)
    stamps, arrivals = np.array(statistics.stamps), np.array(statistics.arrivals)
    numbers = find_pose_numbers(stamps) if topic.time_base == "pose" else set()
    timing = _timing(stamps, arrivals, start) if len(stamps) and not numbers else None
    findings = []
    if statistics.problem:
        which = "message" if statistics.unusable == 1 else f"{statistics.unusable} messages"
        later = ", later ones are used" if statistics.first else ""
        findings.append(f"the first {which} cannot be used{later}: {statistics.problem}")
    if statistics.first and (unit := describe_unit([statistics.first])):
        findings.append(unit)
    if kind == "other" and topic.count and looks_like_sensor(topic.type):
        findings.append(explain_unread(topic.type))
    if len(stamps) < topic.count:
        findings.append(f"holds {len(stamps)} messages, the recording states {topic.count}")
    elif not len(stamps):
        findings.append("has no message")
    if timing and kind in KINDS:
        findings += _findings(stamps, arrivals, timing, has_header="/" in topic.type)
    return TopicReport(
        name=topic.name,
        type=topic.type,
        kind=kind,
        stated=topic.count,
        count=len(stamps),
        frame_id=statistics.first.frame_id if statistics.first else "",
        content=statistics.first.content if statistics.first else "",
        timing=timing,
        pose_numbers=(min(numbers), max(numbers)) if numbers else None,
        findings=tuple(findings),
    )


def _timing(stamps: Array, arrivals: Array, start: float) -> Timing:
    delays = arrivals - stamps
    delay = (float(delays.min()), float(np.median(delays)), float(delays.max()))
    periods = np.diff(stamps)
    if not len(periods):
        return Timing(float(stamps[0] - start), None, None, None, delay)
    median = float(np.median(periods))
    jitter = estimate_spread(periods - median)
    rate = 1 / median if median > 0 else None
    return Timing(float(stamps[0] - start), rate, jitter, float(periods.max()), delay)


def _findings(stamps: Array, arrivals: Array, timing: Timing, *, has_header: bool) -> Iterable[str]:
    periods = np.diff(stamps)
    unset = int(np.sum(stamps == arrivals)) if has_header else 0
    if unset:
        yield f"{_format_share(unset, len(stamps))} header stamps are zero: the time of arrival is taken"
    if backwards := int(np.sum(periods < 0)):
        most, first = _format_seconds(-periods.min()), stamps[:-1][periods < 0][0] - stamps[0]
        yield f"stamps go backwards {_format_times(backwards)}, by up to {most}, first at {first:.1f} s"
    if repeated := int(np.sum(periods == 0)):
        yield f"{_format_times(repeated)} a message has the stamp of the one before"
    if timing.rate and (gaps := periods[periods > _MAX_GAP_PERIODS / timing.rate]).size:
        longest, at = _format_seconds(gaps.max()), stamps[int(np.argmax(periods))] - stamps[0]
        times = _format_times(len(gaps))
        yield f"silent for over {_MAX_GAP_PERIODS:.0f} periods {times}, longest {longest} at {at:.1f} s"
    yield from _drift_findings(arrivals - stamps, unset)


def _drift_findings(delays: Array, unset: int) -> Iterable[str]:
    """Whether the clock of the stamps runs away from the recorder's."""
    tenth = len(delays) // 10
    if tenth and not unset:
        # The least delay is the most constant part of it.
        drift = float(delays[-tenth:].min() - delays[:tenth].min())
        if abs(drift) > _MAX_DRIFT:
            pace = "slow" if drift > 0 else "fast"
            yield f"its clock runs {pace} against the recorder's, by {_format_seconds(abs(drift))} in all"


def _format_share(count: int, total: int) -> str:
    return "all" if count == total else f"{count} of {total}"


def _format_times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _format_seconds(value: float) -> str:
    return f"{1000 * value:.0f} ms" if value < 1 else f"{value:.1f} s"

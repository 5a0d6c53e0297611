"""Recordings made of others: takes in succession, one pose each, and stamps by one clock."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path

from calgraph.errors import InputError
from calgraph.recording.recording import ClosedOnExit, JoinedRecording, Recording, merge_by_arrival, select_topics
from calgraph.sensors import Message, RecordedMessage
from calgraph.sensors.kinds import SENSOR_TYPES

TAKE_GAP = 60.0
"""Time between two takes, s: more than messages of one capture may be apart. A rule of the format, documented with
it."""
_MAX_SPLIT_OVERLAP = 1.0
"""Parts of one recording that was split overlap by less, s: the first message of a file may have been stamped a
little before the last one of the file before it."""
_COMPARED = 100
"""Messages without one of equal stamp in the other recording after which two recordings are different: if both
recorded the same sensor, they share most messages, even where some were lost."""


class ShiftedRecording(ClosedOnExit):
    """A recording whose stamps and arrivals are later by offsets.

    Args:
        recording: as it is.
        stamp_offsets: by topic, s; none of other topics.
        arrival_offsets: likewise.
    """

    def __init__(
        self, recording: Recording, stamp_offsets: Mapping[str, float], arrival_offsets: Mapping[str, float]
    ) -> None:
        self.recording = recording
        self.path, self.sources, self.topics = recording.path, recording.sources, recording.topics
        self.divisible = recording.divisible
        self.stamp_offsets = dict(stamp_offsets)
        self._arrival_offsets = {topic.name: arrival_offsets.get(topic.name, 0.0) for topic in recording.topics}
        offsets = self._arrival_offsets.values()
        self.start = recording.start + min(offsets, default=0.0)
        self.end = recording.end + max(offsets, default=0.0)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of their later arrival; see :meth:`Recording.records`."""
        by_offset: dict[float, set[str]] = defaultdict(set)
        for topic in select_topics(self.path, self.topics, topics):
            by_offset[self._arrival_offsets[topic]].add(topic)
        return merge_by_arrival(
            (self.recording.start + offset, self._read(names, offset, start, end))
            for offset, names in sorted(by_offset.items(), reverse=True)
        )

    def close(self) -> None:
        """Closes the files."""
        self.recording.close()

    def _read(
        self, topics: Collection[str], offset: float, start: float | None, end: float | None
    ) -> Iterator[RecordedMessage]:
        """The records of topics whose arrivals have one offset."""
        first, last = (None if time is None else time - offset for time in (start, end))
        for record in self.recording.records(topics, first, last):
            yield shift_record(record, self.stamp_offsets.get(record.topic, 0.0), offset)


def delay_recording(recording: Recording, offset: float) -> Recording:
    """The recording, with all stamps and arrivals later by an offset, s."""
    offsets = {topic.name: offset for topic in recording.topics}
    return ShiftedRecording(recording, offsets, offsets) if offset else recording


def shift_record(record: RecordedMessage, offset: float, arrival_offset: float) -> RecordedMessage:
    """The record with a stamp and an arrival that are later by offsets, s."""
    return replace(
        record,
        stamp=record.stamp + offset,
        arrival=record.arrival + arrival_offset,
        decode=partial(_decode_later, record.decode, offset),
    )


def _decode_later(decode: Callable[[], Message], offset: float) -> Message:
    message = decode()
    return replace(message, stamp=message.stamp + offset)


class Take(JoinedRecording):
    """The recordings of one take, merged by arrival time."""


@dataclass(frozen=True, eq=False)
class _Timed:
    """A recording, and when its sensors measured."""

    recording: Recording
    spans: Mapping[str, tuple[float, float]]
    """First and last stamp of each topic of a sensor that several recordings have, s."""

    @property
    def begin(self) -> float:
        """The first stamp or arrival, s; 0 where stamps count from the start of the recording."""
        if _counts_from_start(self.recording):
            return 0.0
        return min([self.recording.start, *(first for first, _ in self.spans.values())])

    @property
    def end(self) -> float:
        """The last stamp or arrival, s."""
        return max([self.recording.end, *(last for _, last in self.spans.values())])


def separate_takes(recordings: Sequence[Recording]) -> list[Recording]:
    """The takes that recordings belong to, one after the other.

    A recording belongs to the first take in which none of its sensors measured at the same time: recordings of
    several computers are one take, and so are the parts of a split one. The stamps of each further take are later
    than all those before by at least :data:`TAKE_GAP`.

    Args:
        recordings: in the given order.

    Returns:
        The recordings themselves if they are one take; otherwise one recording a take.

    Raises:
        InputError: two of them have the same messages; or there are several takes of files whose stamps count from
            their own start beside some with those of a clock, so that it is not known which belong together.
    """
    names = Counter(topic for recording in recordings for topic in _list_sensor_topics(recording))
    repeated = {topic for topic, count in names.items() if count > 1}
    takes: list[list[_Timed]] = []
    for recording in recordings:
        timed = _Timed(recording, _find_stamp_spans(recording, repeated))
        # Of every take, so that none is given twice.
        free = [not any(_overlap(timed, other) for other in take) for take in takes]
        if not any(free):
            takes.append([])
        takes[free.index(True) if any(free) else -1].append(timed)
    if len(takes) == 1:
        return list(recordings)
    _check_clocks(recordings, takes[1][0].recording)
    return _place_takes(takes)


def _place_takes(takes: Sequence[Sequence[_Timed]]) -> list[Recording]:
    """The takes, the stamps of each after those of the one before."""
    placed: list[Recording] = []
    end = -math.inf
    for take in takes:
        offset = end + TAKE_GAP - min(one.begin for one in take) if placed else 0.0
        whole = Take([one.recording for one in take]) if len(take) > 1 else take[0].recording
        placed.append(delay_recording(whole, offset))
        end = max([end, *(one.end + offset for one in take)])
    return placed


def describe_takes(recordings: Sequence[Recording], takes: Sequence[Recording]) -> str:
    """Which of the recordings are one take, in words.

    Args:
        recordings: as given, two or more.
        takes: what :func:`separate_takes` made of them.
    """
    if all(take in recordings for take in takes):
        return f"one take: {', '.join(str(one.path) for one in recordings)}"
    start = takes[0].start
    lines = [f"{len(takes)} takes, read one after the other, because sensors repeat at overlapping stamps:"]
    for number, take in enumerate(takes, start=1):
        files = ", ".join(str(path) for path in _list_paths(take))
        lines.append(f"  take {number}: {files} ({take.start - start:.1f} to {take.end - start:.1f} s)")
    return "\n".join(lines)


def _list_paths(take: Recording) -> list[Path]:
    inner = take.recording if isinstance(take, ShiftedRecording) else take
    return [part.path for part in inner.parts] if isinstance(inner, Take) else [inner.path]


def _counts_from_start(recording: Recording) -> bool:
    return all(topic.time_base != "clock" for topic in recording.topics)


def _check_clocks(recordings: Sequence[Recording], second: Recording) -> None:
    """Raises InputError if the second take counts from its own start, but some recordings are by a clock."""
    untimed = [topic.name for topic in second.topics if topic.time_base != "clock"]
    if untimed and any(all(topic.time_base == "clock" for topic in one.topics) for one in recordings):
        raise InputError(
            f"{second.path}: has the topic {untimed[0]}, as another recording has, and its time "
            "counts from its own start: calibrate from one of them, or name the files of one differently"
        )


def _list_sensor_topics(recording: Recording) -> set[str]:
    return {topic.name for topic in recording.topics if topic.type in SENSOR_TYPES and topic.count}


def _find_stamp_spans(recording: Recording, topics: Collection[str]) -> dict[str, tuple[float, float]]:
    """First and last stamp, s, of those of the topics that a recording has."""
    spans = {}
    for topic in sorted(_list_sensor_topics(recording).intersection(topics)):
        # The first message may be without a stamp: its arrival counts then.
        first = min((record.stamp for record in islice(recording.records([topic]), 10)), default=None)
        if first is not None:
            spans[topic] = first, max(first, _find_last_stamp(recording, topic))
    return spans


def _find_last_stamp(recording: Recording, topic: str) -> float:
    """The last stamp of a topic, s, without reading all that is before."""
    window = 1.0
    while True:
        start = recording.end - window
        last = max((record.stamp for record in recording.records([topic], start)), default=None)
        if last is not None or start < recording.start:
            return -math.inf if last is None else last
        window *= 8


def _overlap(one: _Timed, other: _Timed) -> bool:
    """Whether a sensor measured at the same time in two recordings.

    Raises:
        InputError: it did so with the same messages.
    """
    for topic in sorted(one.spans.keys() & other.spans.keys()):
        (begin, end), (other_begin, other_end) = one.spans[topic], other.spans[topic]
        shorter = min(end - begin, other_end - other_begin)
        common = min(end, other_end) - max(begin, other_begin)
        if _counts_from_start(one.recording) or common >= min(0.5 * shorter, _MAX_SPLIT_OVERLAP):
            if _have_same_messages(one.recording, other.recording, topic, max(begin, other_begin)):
                raise InputError(
                    f"{one.recording.path}: has the same messages of {topic} as {other.recording.path}: give "
                    "one of the two, or record this topic in one of them only"
                )
            return True
    return False


def _have_same_messages(recording: Recording, other: Recording, topic: str, start: float) -> bool:
    """Whether all messages with equal stamps, from a stamp on, have equal content, and there are some."""
    streams = [
        (record for record in one.records([topic]) if record.stamp >= start and record.digest)
        for one in (recording, other)
    ]
    a, b = (next(stream, None) for stream in streams)
    compared = different = 0
    while a and b and (compared or different < _COMPARED):
        if a.stamp == b.stamp:
            if a.digest is None or b.digest is None or a.digest().content != b.digest().content:
                return False
            compared += 1
        else:
            different += 1
        advance_a, advance_b = a.stamp <= b.stamp, b.stamp <= a.stamp
        a = next(streams[0], None) if advance_a else a
        b = next(streams[1], None) if advance_b else b
    return compared > 0


class ClockCorrectedRecording(ShiftedRecording):
    """A recording from whose stamps the offsets of clocks are subtracted.

    Arrivals are by the clock of the program that recorded, and stay as they are; of videos and numbered files,
    which have no arrivals, they are the stamps.

    Args:
        recording: with the stamps of all clocks.
        clock_offsets: by topic, its clock minus the reference, s.
    """

    def __init__(self, recording: Recording, clock_offsets: Mapping[str, float]) -> None:
        self.clock_offsets = dict(clock_offsets)
        later = {topic: -offset for topic, offset in clock_offsets.items()}
        own = {topic.name for topic in recording.topics if topic.time_base != "clock"}
        super().__init__(recording, later, {topic: later[topic] for topic in own & later.keys()})
        self.opened_from = recording.opened_from


def correct_stamps(recording: Recording, clock_offsets: Mapping[str, float]) -> Recording:
    """The recording with clock offsets by topic, s, subtracted from its stamps, beside those that were before."""
    if not any(clock_offsets.values()):
        return recording
    if isinstance(recording, ClockCorrectedRecording):
        before = recording.clock_offsets
        clock_offsets = {t: before.get(t, 0.0) + clock_offsets.get(t, 0.0) for t in {*before, *clock_offsets}}
        recording = recording.recording
    return ClockCorrectedRecording(recording, clock_offsets)


class PoseRecordings(JoinedRecording):
    """Recordings of one pose each, one after the other.

    Stamps and arrival times of recordings that overlap, for example because all begin at 0, are shifted so that
    the recordings follow each other in the given order.
    """

    def __init__(self, recordings: Sequence[Recording], topics: Collection[str], gap: float) -> None:
        """Reads the stamps of the topics (not the content of messages).

        Args:
            recordings: in order.
            topics: of the sensors.
            gap: least time between two recordings, s.
        """
        spans = [_find_span(part, topics) for part in recordings]
        ordered = sorted(span for span in spans if span)
        apart = all(b[0] - a[1] > gap for a, b in pairwise(ordered))
        self.poses: list[tuple[float, float]] = []
        parts = []
        for part, span in zip(recordings, spans, strict=True):
            offset = 0.0
            if span and not apart and self.poses:
                offset = self.poses[-1][1] + 2 * gap - span[0]
            if span:
                self.poses.append((span[0] + offset, span[1] + offset))
            parts.append(delay_recording(part, offset))
        self.poses.sort()
        super().__init__(parts)
        # What is read with shifted stamps is not what another run reads from the same files.
        self.sources = ()
        # All stamps are read before the shifts are known; and each of these recordings is short.
        self.divisible = False


def separate_poses(
    recording: Recording, topics: Collection[str], *, stated: bool, max_duration: float, gap: float
) -> Recording:
    """The recording as one of :class:`PoseRecordings` if it consists of recordings of one pose each.

    These are short and measured by several sensors. Without a statement they are also at least three, and no parts
    of one recording: pauses lie between them, or they overlap.

    Args:
        recording: as opened.
        topics: of the sensors.
        stated: whether rig.yaml states snapshots.
        max_duration: maximum duration of the recording of one pose, s.
        gap: time between two recordings, s, above which they are not parts of one.
    """
    offsets = recording.clock_offsets if isinstance(recording, ClockCorrectedRecording) else {}
    joined = recording.recording if isinstance(recording, ClockCorrectedRecording) else recording
    if not isinstance(joined, JoinedRecording):
        return recording
    parts = [correct_stamps(part, offsets) for part in joined.parts]
    if len(parts) < (2 if stated else 3) or any(part.end - part.start > max_duration for part in parts):
        return recording
    measured = [{topic.name for topic in part.topics if topic.count and topic.name in topics} for part in parts]
    several = 2 * sum(len(names) > 1 for names in measured) >= len(parts)
    # Recordings of different sensors at one time, by several computers, have no topic in common.
    if not several or not all(names & measured[0] for names in measured):
        return recording
    ordered = sorted((part.start, part.end) for part in parts)
    consecutive = any(a[0] < b[0] and 0 <= b[0] - a[1] <= gap for a, b in pairwise(ordered))
    return recording if consecutive and not stated else PoseRecordings(parts, topics, gap)


def _find_span(recording: Recording, topics: Collection[str]) -> tuple[float, float] | None:
    """First and last stamp of the topics, s; None without messages."""
    present = {topic.name for topic in recording.topics} & set(topics)
    stamps = [record.stamp for record in recording.records(present)]
    return (min(stamps), max(stamps)) if stamps else None

"""Several takes whose stamps count from the start of each, read one after the other."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial

from calgraph.errors import InputError
from calgraph.recording.recording import ClosedOnExit, Recording
from calgraph.sensors import Message, RecordedMessage

TAKE_GAP = 60.0
"""Time between two takes, s: more than messages of one capture may be apart. A rule of the format, documented with
it."""


class ShiftedRecording(ClosedOnExit):
    """A recording whose stamps and arrivals are later by an offset, s."""

    def __init__(self, recording: Recording, offset: float) -> None:
        self._recording, self._offset = recording, offset
        self.path, self.sources, self.topics = recording.path, recording.sources, recording.topics
        self.start, self.end = recording.start + offset, recording.end + offset
        self.divisible = recording.divisible

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of arrival; see :meth:`Recording.records`."""
        first, last = (None if time is None else time - self._offset for time in (start, end))
        records = self._recording.records(topics, first, last)
        return (shift_record(record, self._offset, self._offset) for record in records)

    def close(self) -> None:
        """Closes the files."""
        self._recording.close()


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


def separate_takes(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings, of which those that repeat a topic whose stamps are not of a clock come later.

    Recordings before the first repeated topic are one take, as files of different cameras are; the one with the
    repeated topic begins the next take.

    Raises:
        InputError: a topic repeats, and other stamps are of a clock, so that the time of its take is not known.
    """
    taken: set[str] = set()
    offset = end = 0.0
    separated: list[Recording] = []
    timed = any(topic.time_base == "clock" for one in recordings for topic in one.topics)
    for recording in recordings:
        untimed = {topic.name for topic in recording.topics if topic.time_base != "clock"}
        if repeated := sorted(untimed & taken):
            if timed:
                raise InputError(
                    f"{recording.path}: has the topic {repeated[0]}, as another recording has, and its time "
                    "counts from its own start: calibrate from one of them, or name the files of one differently"
                )
            offset, taken = end + TAKE_GAP, set()
        taken |= untimed
        separated.append(ShiftedRecording(recording, offset) if offset else recording)
        end = max(end, separated[-1].end)
    return separated

"""A recording whose sensors have different clocks, with all stamps by one of them."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping

from calgraph.recording.recording import ClosedOnExit, Recording, merge_by_arrival, select_topics
from calgraph.recording.takes import shift_record
from calgraph.sensors import RecordedMessage


class ClockCorrectedRecording(ClosedOnExit):
    """A recording from whose stamps the offsets of clocks are subtracted.

    Arrivals are by the clock of the program that recorded, and stay as they are; of videos and numbered files,
    which have no arrivals, they are the stamps.

    Args:
        recording: with the stamps of all clocks.
        clock_offsets: by topic, its clock minus the reference, s.
    """

    def __init__(self, recording: Recording, clock_offsets: Mapping[str, float]) -> None:
        self._recording = recording
        self.clock_offsets = dict(clock_offsets)
        self.path, self.sources, self.topics = recording.path, recording.sources, recording.topics
        self.opened_from, self.divisible = recording.opened_from, recording.divisible
        self._arrival_offsets = {
            topic.name: 0.0 if topic.time_base == "clock" else clock_offsets.get(topic.name, 0.0)
            for topic in recording.topics
        }
        offsets = self._arrival_offsets.values()
        self.start = recording.start - max(offsets, default=0.0)
        self.end = recording.end - min(offsets, default=0.0)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of corrected arrival; see :meth:`Recording.records`."""
        by_offset: dict[float, set[str]] = defaultdict(set)
        for topic in select_topics(self.path, self.topics, topics):
            by_offset[self._arrival_offsets[topic]].add(topic)
        return merge_by_arrival(
            (self._recording.start - offset, self._read(names, offset, start, end))
            for offset, names in sorted(by_offset.items())
        )

    def close(self) -> None:
        """Closes the files."""
        self._recording.close()

    def _read(
        self, topics: Collection[str], offset: float, start: float | None, end: float | None
    ) -> Iterator[RecordedMessage]:
        """The records of topics whose arrivals have one offset."""
        first, last = (None if time is None else time + offset for time in (start, end))
        for record in self._recording.records(topics, first, last):
            yield shift_record(record, -self.clock_offsets.get(record.topic, 0.0), -offset)

"""A recording whose records are indexed when it is opened."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from calgraph.recording.recording import ClosedOnExit, TopicInfo, select_topics
from calgraph.sensors import RecordedMessage


class IndexedRecording(ClosedOnExit):
    """Records that are listed when the recording is opened, and decoded on request.

    Args:
        path: its name in messages.
        records: one record or more, in any order.
        types: by topic.
        untimed: topics whose stamps are not of a clock.
        sources: files and folders that the messages are read from.
    """

    def __init__(
        self,
        path: Path,
        records: Sequence[RecordedMessage],
        types: Mapping[str, str],
        untimed: Collection[str] = (),
        sources: tuple[Path, ...] = (),
    ) -> None:
        self.path, self.sources = path, sources
        self._records = sorted(records, key=lambda record: (record.arrival, record.topic))
        self.start, self.end = self._records[0].arrival, self._records[-1].arrival
        counts = Counter(record.topic for record in records)
        self.topics = tuple(
            TopicInfo(name, types[name], counts[name], name not in untimed) for name in sorted(counts)
        )

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of arrival; see :meth:`Recording.records`."""
        wanted = select_topics(self.path, self.topics, topics)
        return (
            record
            for record in self._records
            if record.topic in wanted
            and (start is None or record.arrival >= start)
            and (end is None or record.arrival <= end)
        )

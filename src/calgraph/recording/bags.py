"""ROS bags: rosbag2 in SQLite or MCAP files, and ROS 1 bags.

The storage files are read one by one rather than through rosbags' reader of whole folders: that one matches topics
including their QoS settings and silently drops those whose metadata.yaml differs from the storage.
"""

import math
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.recording.bag_files import (
    BagFiles,
    check_sqlite,
    decompress_message,
    decompress_storage,
    is_compressed,
)
from calgraph.recording.chunk_limits import has_index, is_finished, open_reader
from calgraph.recording.damage import check_fetched, wrap_errors
from calgraph.recording.message_types import MessageType, TypeDefinition, message_type
from calgraph.recording.record_list import make_record, place_of
from calgraph.recording.recording import (
    ClosedOnExit,
    TopicInfo,
    check_message_counts,
    merge_by_arrival,
    merge_topics,
    select_topics,
)
from calgraph.recording.video_messages import KEYFRAME_TIME, VideoStream, is_video
from calgraph.sensors import RecordedMessage
from calgraph.sensors.kinds.camera import VIDEO_TYPES

_ADVICE = {
    ".bag": "it may be truncated: try `rosbag reindex` and `rosbag check`, or copy it again",
    ".mcap": "it may be truncated: try `mcap recover {name} -o fixed.mcap`, or copy it again",
    ".db3": "it may be truncated: try `sqlite3 {name} .recover | sqlite3 fixed.db3`, or copy it again",
}
# Float seconds resolve 0.24 µs; the query is widened by this margin and filtered exactly afterwards.
_MARGIN_NS = 1000


class RawMessage(NamedTuple):
    """One message as a bag stores it."""

    topic: str
    definition: TypeDefinition
    """Of its type."""
    arrival: int
    """ns."""
    data: bytes
    """Serialised, without compression."""


class BagRecording(ClosedOnExit):
    """A bag of one or more storage files.

    Attributes:
        notices: what is missing of it although it can be read, in words.
    """

    def __init__(self, path: Path, bag: BagFiles, limits: LimitSettings) -> None:
        self.path, self.sources = path, (path,)
        self._limits = limits
        self._types: dict[tuple[str, str, str], MessageType] = {}
        self._stack = ExitStack()
        try:
            self._readers = tuple(self._open(file) for file in bag.files)
        except BaseException:
            self._stack.close()
            raise
        # A compressed file is unpacked when it is opened, and all of one without an index is read.
        self.divisible = not any(is_compressed(file) for file in bag.files) and all(map(has_index, self._readers))
        filled = [reader for reader in self._readers if reader.message_count]
        self.notices = tuple(_describe_unfinished(reader) for reader in self._readers if not is_finished(reader))
        self.start = min((reader.start_time for reader in filled), default=0) / 1e9
        # The readers' end is one nanosecond after the last message.
        self.end = max((reader.end_time - 1 for reader in filled), default=0) / 1e9
        # What was recorded or copied after the end that is missing is known to be missing.
        self.topics = _topics(self._readers, () if self.notices else bag.stated)
        self._videos = frozenset(topic.name for topic in self.topics if topic.type in VIDEO_TYPES)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages in order of arrival; see :meth:`Recording.records`."""
        wanted = select_topics(self.path, self.topics, topics)
        records = merge_by_arrival(
            (reader.start_time / 1e9, self._records_of(reader, wanted, start, end))
            for reader in self._readers
            if reader.message_count
        )
        if start is not None or end is not None:
            return records
        stated = {topic.name: topic.count for topic in self.topics if topic.name in wanted}
        return check_message_counts(
            self.path, records, stated, cause="a file is missing or was not closed: copy it again or reindex it"
        )

    def raw_messages(self, topics: Collection[str], after: int = -1) -> Iterator[RawMessage]:
        """The messages that arrived after a time (ns), as they are stored, in order of arrival.

        Raises:
            InputError: a topic is not in the recording.
            RecordingError: the file is damaged.
        """
        wanted = select_topics(self.path, self.topics, topics)
        return merge_by_arrival(
            (reader.start_time, self._raw_messages_of(reader, wanted, after))
            for reader in self._readers
            if reader.message_count
        )

    def close(self) -> None:
        """Closes the storage files and removes uncompressed copies."""
        self._stack.close()

    def _open(self, file: Path) -> Reader1 | Reader2:
        if file.stat().st_size == 0:
            raise RecordingError(f"{file}: is empty; copy it again")
        check_fetched(file)
        storage = decompress_storage(file, self._stack, self._limits)
        with wrap_errors(file, _ADVICE[storage.suffix].format(name=file.name)):
            if storage.suffix == ".db3":
                check_sqlite(storage)
            reader = open_reader(storage, self._limits)
            self._stack.callback(reader.close)
            for connection in reader.connections:
                # Columns of a database hold values of any type.
                if not all(isinstance(text, str) for text in (connection.topic, connection.msgtype)):
                    raise ValueError(f"the name {connection.topic!r:.40} of a topic, or its type, is no text")
        return reader

    def _records_of(
        self, reader: Reader1 | Reader2, topics: set[str], start: float | None, end: float | None
    ) -> Iterator[RecordedMessage]:
        start_ns = None if start is None else max(0, math.floor(start * 1e9) - _MARGIN_NS)
        stop_ns = None if end is None else math.ceil(end * 1e9) + _MARGIN_NS
        if start_ns and topics.intersection(self._videos):
            start_ns = max(0, start_ns - round(KEYFRAME_TIME * 1e9))
        videos: dict[str, VideoStream] = {}
        for kind, message in self._stored_messages(reader, topics, start_ns, stop_ns):
            arrival = message.arrival / 1e9
            is_wanted = (start is None or arrival >= start) and (end is None or arrival <= end)
            if not (is_wanted or is_video(kind)):
                continue
            record = make_record(kind, message.topic, arrival, message.data, self.path, self._limits)
            if is_video(kind):
                stream = videos.setdefault(message.topic, VideoStream(self._limits))
                record = replace(
                    record, decode=stream.add(kind, message.data, record.stamp, place_of(self.path, record))
                )
            if is_wanted:
                yield record

    def _raw_messages_of(self, reader: Reader1 | Reader2, topics: set[str], after: int) -> Iterator[RawMessage]:
        messages = (message for _, message in self._stored_messages(reader, topics, max(0, after), None))
        return (message for message in messages if message.arrival > after)

    def _stored_messages(
        self, reader: Reader1 | Reader2, topics: set[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[MessageType, RawMessage]]:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        path = Path(str(reader.path))
        kinds: dict[int, MessageType] = {}
        with wrap_errors(path, _ADVICE[path.suffix].format(name=path.name)):
            for connection, arrival, raw in reader.messages(connections, start_ns, stop_ns):
                if connection.topic not in topics:
                    continue  # a damaged index names a message of another connection
                kind = kinds.get(connection.id)
                if kind is None:
                    kind = kinds[connection.id] = self._type(connection)
                data = decompress_message(raw, self._limits)
                yield kind, RawMessage(connection.topic, kind.definition, arrival, data)

    def _type(self, connection: Connection) -> MessageType:
        key = (connection.msgtype, connection.msgdef.data, str(connection.ext))
        if key not in self._types:
            self._types[key] = message_type(connection)
        return self._types[key]


def _describe_unfinished(reader: Reader1 | Reader2) -> str:
    duration = (reader.end_time - 1 - reader.start_time) / 1e9
    return (
        f"{reader.path}: has no end, as its recorder was killed or its copy is incomplete: it is read up to the "
        f"last complete chunk, {duration:.2f} s after its first message"
    )


def _topics(readers: tuple[Reader1 | Reader2, ...], stated: tuple[TopicInfo, ...]) -> tuple[TopicInfo, ...]:
    """Topics with the larger of the counts that metadata.yaml and the storage files state."""
    stored = merge_topics(
        TopicInfo(name, topic.connections[0].msgtype, topic.msgcount)
        for reader in readers
        for name, topic in reader.topics.items()
    )
    counts = {topic.name: topic for topic in merge_topics(stated)}
    for topic in stored:
        count = max(topic.count, counts.get(topic.name, topic).count)
        counts[topic.name] = TopicInfo(topic.name, topic.type, count)
    return tuple(counts[name] for name in sorted(counts))

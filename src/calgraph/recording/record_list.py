"""Recordings whose records are indexed when they are opened, and messages in memory, which are read like one."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError
from calgraph.recording.content_hash import hash_array
from calgraph.recording.damage import wrap_errors
from calgraph.recording.decoding import decode
from calgraph.recording.message_types import MessageType
from calgraph.recording.recording import ClosedOnExit, TimeBase, TopicInfo, select_topics
from calgraph.sensors import CameraInfo, Message, MessageDigest, RecordedMessage, Trigger


class IndexedRecording(ClosedOnExit):
    """Records that are listed when the recording is opened, and decoded on request.

    Args:
        path: its name in messages.
        records: one record or more, in any order.
        types: by topic.
        time_bases: by topic, where stamps are not those of a clock.
        sources: files and folders that the messages are read from.
    """

    def __init__(
        self,
        path: Path,
        records: Sequence[RecordedMessage],
        types: Mapping[str, str],
        time_bases: Mapping[str, TimeBase] = MappingProxyType({}),
        sources: tuple[Path, ...] = (),
    ) -> None:
        self.path, self.sources = path, sources
        self._records = sorted(records, key=lambda record: (record.arrival, record.topic))
        self.start, self.end = self._records[0].arrival, self._records[-1].arrival
        counts = Counter(record.topic for record in records)
        self.topics = tuple(
            TopicInfo(name, types[name], counts[name], time_bases.get(name, "clock")) for name in sorted(counts)
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


class _Place(NamedTuple):
    """Where a message is; as text, which takes longer to make than all else of a record, in errors only."""

    source: object
    topic: str
    time: str
    """Which time is known of it."""
    value: float
    """s."""

    def __str__(self) -> str:
        return f"{self.source}: topic {self.topic}, {self.time} {self.value:.6f}"


def place_of(source: object, record: RecordedMessage) -> object:
    """Where a message is, for error messages."""
    return _Place(source, record.topic, "stamp", record.stamp)


def make_record(
    kind: MessageType, topic: str, arrival: float, raw: bytes, source: object, limits: LimitSettings
) -> RecordedMessage:
    """The record of a message, whose content is decoded on demand.

    Args:
        kind: the message's type.
        topic: its topic.
        arrival: when it arrived, s.
        raw: its serialised bytes.
        source: the file or address that it comes from, for error messages; it is pickled with the record.
        limits: of its content.

    Raises:
        RecordingError: its header cannot be read.
    """
    try:
        header_stamp = kind.header_stamp(raw)
    except Exception:
        with wrap_errors(_Place(source, topic, "arrival", arrival)):
            raise
    stamp = arrival if header_stamp is None else header_stamp / 1e9
    place = _Place(source, topic, "stamp", stamp)
    return RecordedMessage(
        topic, stamp, arrival, partial(decode, kind, raw, stamp, place, limits), partial(kind.digest, raw)
    )


class MessageRecording(IndexedRecording):
    """Messages by topic as a recording, for scans, clouds and images that are arrays already.

    Args:
        messages: by topic, in any order; they arrive at their stamps.

    Raises:
        InputError: there are none.
    """

    def __init__(self, messages: Mapping[str, Sequence[Message]]) -> None:
        listed = [record_message(topic, message) for topic, sent in messages.items() for message in sent]
        if not listed:
            raise InputError("no messages are given; a recording needs one at least")
        types = {topic: sent[0].topic_type for topic, sent in messages.items() if sent}
        super().__init__(Path("messages"), listed, types)


def record_message(topic: str, message: Message) -> RecordedMessage:
    """The record of a message, which arrives at its stamp."""
    return RecordedMessage(topic, message.stamp, message.stamp, partial(_get, message), partial(_digest, message))


def _get(message: Message) -> Message:
    """The message: unlike a local function, a partial of this one can be pickled."""
    return message


def _digest(message: Message) -> MessageDigest:
    if isinstance(message, CameraInfo):
        camera = message.camera
        content = hash(
            (camera.model, camera.width, camera.height, hash_array(camera.K), hash_array(camera.distortion))
        )
        return MessageDigest(message.frame_id, content)
    if isinstance(message, Trigger):
        return MessageDigest("", hash_array(np.zeros(0)))
    return MessageDigest(message.frame_id, hash_array(getattr(message, message.measured)))

"""Messages that a program has at hand, read like a recording."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from calgraph.errors import InputError
from calgraph.recording.recording import TopicInfo, wanted_topics
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, PointCloud, Record, Trigger

_TYPES = {Image: "image", LaserScan: "scan", PointCloud: "cloud", CameraInfo: "camera_info", Trigger: "trigger"}


class MessageRecording:
    """Messages by topic as a recording, for scans, clouds and images that are arrays already.

    Args:
        messages: by topic, in any order; they arrive at their stamps.

    Raises:
        InputError: there are none.
    """

    def __init__(self, messages: Mapping[str, Sequence[Message]]) -> None:
        stamped = [(message.stamp, topic, message) for topic, sent in messages.items() for message in sent]
        if not stamped:
            raise InputError("no messages are given; a recording needs one at least")
        self._messages = sorted(stamped, key=lambda entry: entry[:2])
        self.path = Path("messages")
        self.start, self.end = self._messages[0][0], self._messages[-1][0]
        self.topics = tuple(
            TopicInfo(topic, _TYPES[type(messages[topic][0])], len(messages[topic]))
            for topic in sorted(messages)
            if messages[topic]
        )

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[Record]:
        """The messages in order of their stamps; see :meth:`Recording.records`."""
        wanted = wanted_topics(self.path, self.topics, topics)
        return (
            Record(topic, stamp, stamp, lambda message=message: message)  # type: ignore[misc]
            for stamp, topic, message in self._messages
            if topic in wanted and (start is None or stamp >= start) and (end is None or stamp <= end)
        )

    def close(self) -> None:
        """Does nothing: no file is open."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

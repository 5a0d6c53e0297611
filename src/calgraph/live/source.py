"""The interface of a live source: messages as they arrive, and notices of what happens to the connection."""

import re
from collections.abc import AsyncIterator, Collection, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

from calgraph.sensors.kinds.stated import CONTROL_CHARACTERS

Encoding = Literal["cdr", "ros1"]
SchemaFormat = Literal["ros2msg", "ros2idl", "ros1msg"]


@dataclass(frozen=True)
class Channel:
    """One topic as a source serves it."""

    topic: str
    type: str
    """``package/msg/Name``, for ROS 1 too."""
    encoding: Encoding
    """Of its messages."""
    schema_format: SchemaFormat
    schema: str
    """The definitions of the type and of those it contains."""


@dataclass(frozen=True, eq=False)
class LiveMessage:
    """One message as it was sent."""

    channel: Channel
    arrival: int
    """When the source's server received it, by its clock; ns since the epoch."""
    data: bytes
    """Serialised as the channel's encoding states."""


NoticeKind = Literal["connected", "disconnected", "missing", "lost", "refused", "ended"]


@dataclass(frozen=True)
class Notice:
    """What happens to a connection.

    ``connected``: messages can come; ``disconnected``: the server is gone, and another attempt follows;
    ``missing``: a topic that is wanted is not served, or cannot be read; ``lost``: messages are known to be lost;
    ``refused``: a message or a frame of the protocol could not be used; ``ended``: no message follows.
    """

    kind: NoticeKind
    text: str
    """One sentence for the operator."""
    topic: str | None = None
    """The topic that it concerns."""
    count: int = 0
    """How many messages or frames it stands for, if they were lost or refused."""


class Source(Protocol):
    """Where live messages come from."""

    @property
    def name(self) -> str:
        """What the user gave: an address, or the path of a recording."""

    def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        """Messages of the topics wanted, and notices, until the source ends or the iterator is closed.

        Connects, and connects again where the connection breaks.

        Raises:
            InputError: the source can never be used: a malformed address, or a missing library.
        """


# Texts of servers are cut: they may have any length.
_MAX_TEXT = 300
_CONTROL_CHARACTERS = re.compile(f"[{CONTROL_CHARACTERS}]+")


class NoticeLimiter:
    """Collects notices, and gives one for all of a kind and topic that came within an interval (s).

    Times are those of one clock, s.
    """

    def __init__(self, interval: float) -> None:
        self._interval = interval
        self._waiting: dict[tuple[NoticeKind, str | None], tuple[str, int]] = {}
        self._given: dict[tuple[NoticeKind, str | None], float] = {}

    def add(self, kind: NoticeKind, text: str, topic: str | None = None, count: int = 0) -> None:
        """Adds a notice; of several, the first one's text is given, and the sum of their counts."""
        first, before = self._waiting.get((kind, topic), (text, 0))
        self._waiting[kind, topic] = first, before + count

    def take(self, now: float) -> Iterator[Notice]:
        """The notices whose interval is over."""
        if not self._waiting:
            return
        for key in list(self._waiting):
            if now - self._given.get(key, float("-inf")) >= self._interval:
                text, count = self._waiting.pop(key)
                self._given[key] = now
                kind, topic = key
                yield Notice(kind, clean_text(text), topic, count)


def clean_text(text: str) -> str:
    """A text that may come from a server, on one line."""
    line = _CONTROL_CHARACTERS.sub(" ", text)
    return line if len(line) <= _MAX_TEXT else f"{line[:_MAX_TEXT]} ..."

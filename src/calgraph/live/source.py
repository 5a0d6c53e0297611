"""The interface of a live source: messages as they arrive, and notices of what happens to the connection."""

from collections.abc import AsyncIterator, Collection
from dataclasses import dataclass
from typing import Literal, Protocol

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

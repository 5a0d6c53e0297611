"""The interface of a live source: messages as they arrive, and notices of what happens to the connection."""

import re
from collections.abc import AsyncIterator, Collection
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal, Protocol

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.config.settings import LimitSettings
from calgraph.recording.message_types import MessageType, TypeDefinition, make_message_type, ros2_definition
from calgraph.recording.record_list import make_record
from calgraph.recording.writer import serialize_message
from calgraph.sensors import Message, RecordedMessage
from calgraph.sensors.kinds import SENSOR_TYPES
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

    @cached_property
    def message_type(self) -> MessageType:
        """The type of its messages."""
        idl = self.schema_format == "ros2idl"
        text_format = MessageDefinitionFormat.IDL if idl else MessageDefinitionFormat.MSG
        return make_message_type(TypeDefinition(self.type, text_format, self.schema, self.encoding))


@dataclass(frozen=True, eq=False)
class LiveMessage:
    """One message as it was sent."""

    channel: Channel
    arrival: int
    """When the source's server received it, by its clock; ns since the epoch."""
    data: bytes
    """Serialised as the channel's encoding states."""

    def read_stamp(self) -> int | None:
        """The header's stamp of a sensor's message, ns; None of other messages, and of headers without one."""
        if self.channel.type not in SENSOR_TYPES:
            return None
        try:
            return self.channel.message_type.header_stamp(self.data) or None
        except Exception:  # damaged: the decoder states why
            return None

    def read(self, source: str, limits: LimitSettings) -> RecordedMessage:
        """The record as a recording has it; the stamp is the arrival where it has no header.

        Args:
            source: name of the source, for error messages.
            limits: of the content of messages.

        Raises:
            RecordingError: its header cannot be read.
        """
        channel = self.channel
        return make_record(channel.message_type, channel.topic, self.arrival / 1e9, self.data, source, limits)


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

    name: str
    """What the user gave: an address, or the path of a recording."""
    max_lead: float
    """Time by which messages may be ahead of the detection before they wait until it has caught up, s; with 0 each
    waits until all before it are analysed. Infinite for robots, which do not wait."""

    def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice | None]:
        """Messages of the topics wanted, and notices, until the source ends or the iterator is closed.

        Connects, and connects again where the connection breaks. None only shows that time has passed.

        Raises:
            InputError: the source can never be used: a malformed address, or a missing library.
        """


# Texts of servers are cut: they may have any length.
_MAX_TEXT = 300
_CONTROL_CHARACTERS = re.compile(f"[{CONTROL_CHARACTERS}]+")


def clean_text(text: str) -> str:
    """A text that may come from a server, on one line."""
    line = _CONTROL_CHARACTERS.sub(" ", text)
    return line if len(line) <= _MAX_TEXT else f"{line[:_MAX_TEXT]} ..."


def make_message(topic: str, message: Message, arrival: int) -> LiveMessage:
    """A message as a node of ROS 2 sends it.

    Args:
        topic: of the message.
        message: its content.
        arrival: of the message, ns.
    """
    kind, data = serialize_message(_load_store(), message)
    definition = ros2_definition(kind)
    assert definition is not None
    return LiveMessage(Channel(topic, kind, "cdr", "ros2msg", definition.text), arrival, bytes(data))


@cache
def _load_store() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)

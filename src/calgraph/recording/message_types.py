"""ROS message types as one recording defines them: their header stamps, read cheaply, and their content."""

import logging
import re
import struct
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

from calgraph.recording.content_hash import hash_content
from calgraph.recording.damage import LimitedStore, check_arrays, check_definition
from calgraph.recording.driver_types import DEFINITIONS
from calgraph.recording.foxglove_messages import decode_foxglove, is_foxglove
from calgraph.sensors import MessageDigest
from calgraph.sensors.kinds.stated import CONTROL_CHARACTERS, MAX_NAME_LENGTH

_log = logging.getLogger(__name__)

_HEADER, _TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
# In place of a header, Foxglove's messages have a time and a frame_id.
_TIMESTAMP = "timestamp"
# Where the characters of a leading header's frame_id begin, both in CDR and as ROS 1 serialises.
_FRAME = 16
_IDL_SEPARATOR = "=" * 80 + "\n"
_CONTROL_CHARACTERS = re.compile(f"[{CONTROL_CHARACTERS}]")
# Types of a recording whose parsed definitions are kept, for unpickling.
_MAX_TYPES = 256


class TypeDefinition(NamedTuple):
    """A message type as a recording defines it."""

    name: str
    """``package/msg/Name``, for ROS 1 too."""
    format: MessageDefinitionFormat
    """The language of the text."""
    text: str
    """The definitions of the type and of those it contains."""
    encoding: str
    """How messages are serialised, as MCAP calls it: ``cdr`` (ROS 2), ``ros1``, ``protobuf``, ``json``, …"""

    @property
    def is_ros(self) -> bool:
        """Whether messages are serialised as ROS 1 or ROS 2 does."""
        return self.encoding in ("cdr", "ros1")


@dataclass(frozen=True, eq=False)
class MessageType:
    """A message type, with what is needed to read its messages; pickled as its definition."""

    definition: TypeDefinition
    """As the recording states it."""
    store: Typestore | None
    """Knows the fields; None where the definition is missing or cannot be parsed."""
    header: str | None
    """Name of the field with the header, or with Foxglove's time; empty if the message is itself a header, None
    without one."""
    header_is_first: bool
    """Whether the message's bytes start with the header."""

    @property
    def name(self) -> str:
        """``package/msg/Name``, for ROS 1 too."""
        return self.definition.name

    @property
    def ros1(self) -> bool:
        """Serialised as ROS 1 does, else as CDR."""
        return self.definition.encoding == "ros1"

    @property
    def is_known(self) -> bool:
        """Whether its fields are known."""
        return self.store is not None or self.header == _TIMESTAMP

    def __reduce__(self) -> tuple[Any, ...]:
        # Stores contain classes made at run time, which cannot be pickled.
        return make_message_type, (self.definition,)

    def deserialize(self, raw: bytes) -> Any:
        """The message as an object with the fields of its definition.

        Raises:
            ValueError: the definition is unknown, or the bytes do not fit it.
            rosbags.serde.SerdeError: the bytes do not fit the definition.
        """
        if not self.definition.is_ros:
            return decode_foxglove(raw, self.name, self.definition.encoding)
        if self.store is None:
            raise ValueError(f"the definition of type {self.name} is unknown")
        if self.ros1:
            return self.store.deserialize_ros1(raw, self.name)
        return self.store.deserialize_cdr(raw, self.name)

    def header_stamp(self, raw: bytes) -> int | None:
        """The header's stamp, ns, or None where there is no header or its stamp was never set (zero).

        Raises:
            ValueError: the message is too short to hold its header.
            rosbags.serde.SerdeError: a header inside the message cannot be reached.
        """
        if self.header is None:
            return None
        if self.header_is_first:
            stamp = _leading_stamp(raw, ros1=self.ros1)
        else:
            header = getattr(self.deserialize(raw), self.header)
            time = header if self.header == _TIMESTAMP else header.stamp
            stamp = time.sec * 10**9 + time.nanosec
        return stamp or None

    def digest(self, raw: bytes) -> MessageDigest:
        """The frame and a hash of the content of a message; without a leading header, of all of it."""
        if self.header == _TIMESTAMP:
            with suppress(Exception):  # of damaged bytes, of which the decoder states where they are
                message = self.deserialize(raw)
                content = getattr(message, "data", None)
                hashed = hash_content(raw if content is None else bytes(content))
                return MessageDigest(clean_frame_id(message.frame_id), hashed)
        if not self.header_is_first or len(raw) < _FRAME:
            return MessageDigest("", hash_content(raw))
        big_endian = not self.ros1 and not raw[1] & 1
        (length,) = struct.unpack_from(">I" if big_endian else "<I", raw, _FRAME - 4)
        end = _FRAME + length
        frame_id = clean_frame_id(raw[_FRAME:end].rstrip(b"\0").decode(errors="replace"))
        # CDR aligns what follows to 4 bytes.
        return MessageDigest(frame_id, hash_content(raw, end if self.ros1 else end + -end % 4))


def clean_frame_id(text: str) -> str:
    """The frame of a header as results state it: without control characters, and no longer than names may be."""
    return _CONTROL_CHARACTERS.sub("", text)[:MAX_NAME_LENGTH]


def serialization_of(connection: Connection) -> str:
    """How the messages of a connection are serialised, as MCAP calls it."""
    ext = connection.ext
    return ext.serialization_format or "cdr" if isinstance(ext, ConnectionExtRosbag2) else "ros1"


def message_type(connection: Connection) -> MessageType:
    """The type of a connection's messages: as the recording defines it, else as ROS or Foxglove do."""
    encoding = serialization_of(connection)
    definition = connection.msgdef
    kind = make_message_type(TypeDefinition(connection.msgtype, definition.format, definition.data, encoding))
    if not kind.is_known:
        _log.debug(
            "topic %s: type %s is unknown, its messages serve as triggers only", connection.topic, kind.name
        )
    return kind


@lru_cache(maxsize=_MAX_TYPES)
def make_message_type(definition: TypeDefinition) -> MessageType:
    """The type that a definition describes."""
    name = definition.name
    if not definition.is_ros:
        known = is_foxglove(name) and definition.encoding in ("protobuf", "json")
        return MessageType(definition, None, _TIMESTAMP if known else None, False)
    store = _make_store(definition)
    if store is None:
        return MessageType(definition, None, None, False)
    if name == _HEADER:
        return MessageType(definition, store, "", True)
    fields = store.fielddefs[name][1]
    headers = [field for field, kind in fields if kind == (Nodetype.NAME, _HEADER)]
    if is_foxglove(name) and (_TIMESTAMP, (Nodetype.NAME, _TIME)) in fields:
        return MessageType(definition, store, _TIMESTAMP, False)
    if not headers:
        return MessageType(definition, store, None, False)
    return MessageType(definition, store, headers[0], fields[0][0] == headers[0])


def complete_definition(definition: TypeDefinition) -> TypeDefinition | None:
    """The definition itself, or ROS's own where it has no text, as of recordings before ROS 2 Iron.

    None where ROS has no such type either.
    """
    if definition.format != MessageDefinitionFormat.NONE and definition.text:
        return definition
    store = _default_store(definition.encoding)
    if definition.name not in store.fielddefs:
        return None
    text, _ = store.generate_msgdef(definition.name, ros_version=1 if definition.encoding == "ros1" else 2)
    return definition._replace(format=MessageDefinitionFormat.MSG, text=text)


def ros2_definition(name: str) -> TypeDefinition | None:
    """The definition of a type of ROS 2, serialised as CDR; None where ROS 2 has none of this name."""
    return complete_definition(TypeDefinition(name, MessageDefinitionFormat.NONE, "", "cdr"))


def _make_store(definition: TypeDefinition) -> Typestore | None:
    """A separate store for each type, so that a malformed definition does not affect other topics."""
    try:
        check_definition(definition.text)
        store: Typestore = LimitedStore()
        if definition.format == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(definition.text, definition.name))
        elif definition.format == MessageDefinitionFormat.IDL:
            for part in _idl_parts(definition.text):
                store.register(get_types_from_idl(part))
        if definition.name in store.fielddefs:
            check_arrays(store, definition.name)
            return store
    except Exception as error:  # the parsers raise many kinds, and the topic may not be needed
        _log.debug("definition of %s not understood: %s", definition.name, error)
    default = _default_store(definition.encoding)
    return default if definition.name in default.fielddefs else None


def _idl_parts(text: str) -> list[str]:
    if not text.startswith(f"{_IDL_SEPARATOR}IDL: "):
        return [text]
    return [part.split("\n", 1)[1] for part in text.split(_IDL_SEPARATOR)[1:]]


@cache
def _default_store(encoding: str) -> Typestore:
    store = LimitedStore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _leading_stamp(raw: bytes, *, ros1: bool) -> int:
    if len(raw) < 12:
        raise ValueError(f"a message of {len(raw)} bytes is too short for a header")
    code = "<II" if ros1 else "<iI" if raw[1] & 1 else ">iI"
    seconds, nanoseconds = struct.unpack_from(code, raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds)

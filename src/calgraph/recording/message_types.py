"""ROS message types as one recording defines them: their header stamps, read cheaply, and their content."""

import logging
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.recording.digest import hash_content
from calgraph.sensors import MessageDigest

_log = logging.getLogger(__name__)

_HEADER = "std_msgs/msg/Header"
# Where the characters of a leading header's frame_id begin, both in CDR and as ROS 1 serialises.
_FRAME = 16
_IDL_SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True, eq=False)
class MessageType:
    """A message type, with what is needed to read its messages."""

    name: str
    """``package/msg/Name``, for ROS 1 too."""
    store: Typestore | None
    """Knows the fields; None where the definition is missing or cannot be parsed."""
    ros1: bool
    """Serialised as ROS 1 does, else as CDR."""
    header: str | None
    """Name of the field with the header; empty if the message is itself a header, None if it has none."""
    header_is_first: bool
    """Whether the message's bytes start with the header."""

    def deserialize(self, raw: bytes) -> Any:
        """The message as an object with the fields of its definition.

        Raises:
            ValueError: the definition is unknown.
            rosbags.serde.SerdeError: the bytes do not fit the definition.
        """
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
            stamp = _leading_stamp_ros1(raw) if self.ros1 else _leading_stamp_cdr(raw)
        else:
            time = getattr(self.deserialize(raw), self.header).stamp
            stamp = time.sec * 10**9 + time.nanosec
        return stamp or None

    def digest(self, raw: bytes) -> MessageDigest:
        """The frame and a hash of the content of a message; without a leading header, of all of it."""
        if not self.header_is_first or len(raw) < _FRAME:
            return MessageDigest("", hash_content(raw))
        big_endian = not self.ros1 and not raw[1] & 1
        (length,) = struct.unpack_from(">I" if big_endian else "<I", raw, _FRAME - 4)
        end = _FRAME + length
        frame_id = raw[_FRAME:end].rstrip(b"\0").decode(errors="replace")
        # CDR aligns what follows to 4 bytes.
        return MessageDigest(frame_id, hash_content(raw, end if self.ros1 else end + -end % 4))


def message_type(connection: Connection, *, ros1: bool) -> MessageType:
    """The type of a connection's messages: as the recording defines it, else as ROS does."""
    name = connection.msgtype
    readable = (
        ros1
        or not isinstance(connection.ext, ConnectionExtRosbag2)
        or (connection.ext.serialization_format in ("cdr", ""))
    )
    store = _store_for(connection, ros1=ros1) if readable else None
    if store is None:
        _log.debug("topic %s: type %s is unknown, its messages serve as triggers only", connection.topic, name)
        return MessageType(name, None, ros1, None, False)
    if name == _HEADER:
        return MessageType(name, store, ros1, "", True)
    fields = store.fielddefs[name][1]
    headers = [field for field, kind in fields if kind == (Nodetype.NAME, _HEADER)]
    if not headers:
        return MessageType(name, store, ros1, None, False)
    return MessageType(name, store, ros1, headers[0], fields[0][0] == headers[0])


def _store_for(connection: Connection, *, ros1: bool) -> Typestore | None:
    """A separate store for each type, so that a malformed definition does not affect other topics."""
    definition = connection.msgdef
    try:
        store = get_typestore(Stores.EMPTY)
        if definition.format == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(definition.data, connection.msgtype))
        elif definition.format == MessageDefinitionFormat.IDL:
            for part in _idl_parts(definition.data):
                store.register(get_types_from_idl(part))
        if connection.msgtype in store.fielddefs:
            return store
    except Exception as error:  # the parsers raise many kinds, and the topic may not be needed
        _log.debug("topic %s: definition of %s not understood: %s", connection.topic, connection.msgtype, error)
    default = _default_store(ros1)
    return default if connection.msgtype in default.fielddefs else None


def _idl_parts(text: str) -> list[str]:
    if not text.startswith(f"{_IDL_SEPARATOR}IDL: "):
        return [text]
    return [part.split("\n", 1)[1] for part in text.split(_IDL_SEPARATOR)[1:]]


@cache
def _default_store(ros1: bool) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


def _leading_stamp_cdr(raw: bytes) -> int:
    if len(raw) < 12:
        raise ValueError(f"a message of {len(raw)} bytes is too short for a header")
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _leading_stamp_ros1(raw: bytes) -> int:
    if len(raw) < 12:
        raise ValueError(f"a message of {len(raw)} bytes is too short for a header")
    seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds)

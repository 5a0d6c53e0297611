"""Messages as ROS 2 records them: CDR, with the definitions of ROS 2."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from rosbags.convert.converter import is_same_wireformat
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys.store import Typestore

from calgraph.live.source import Channel
from calgraph.recording.message_limits import LimitedStore
from calgraph.recording.message_types import MessageType, TypeDefinition, make_message_type, ros2_definition

_HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class CdrSchema:
    """How messages of a channel are recorded."""

    encoding: Literal["ros2msg", "ros2idl"]
    """The language of the definitions."""
    text: str
    convert: Callable[[bytes], bytes]
    """A message of the channel to CDR; raises what rosbags does where it does not fit its definition."""


def make_cdr_schema(channel: Channel) -> CdrSchema:
    """The definitions and the conversion for a channel; without one for CDR.

    Messages of ROS 1 become those of ROS 2 of the same name where the fields have the same types, and keep their
    definition otherwise. Headers lose ``seq``, which those of ROS 2 do not have.

    Raises:
        ValueError: the definition of a type of ROS 1 is unknown.
    """
    if channel.encoding == "cdr":
        idl = channel.schema_format == "ros2idl"
        return CdrSchema("ros2idl" if idl else "ros2msg", channel.schema, bytes)
    source = make_message_type(
        TypeDefinition(channel.type, MessageDefinitionFormat.MSG, channel.schema, ros1=True, readable=True)
    )
    if source.store is None:
        raise ValueError(f"the definition of type {channel.type} is unknown")
    store = _find_ros2_store(source, source.store)
    text, _ = store.generate_msgdef(channel.type, ros_version=2)
    return CdrSchema("ros2msg", text, partial(_convert, source, store))


def _find_ros2_store(source: MessageType, store: Typestore) -> Typestore:
    """The types of ROS 2 that a type of ROS 1 is converted to."""
    same = ros2_definition(source.name)
    target = make_message_type(same).store if same else None
    if target is not None and is_same_wireformat(store, target, source.name, source.name):
        return target
    header = ros2_definition(_HEADER)
    assert header is not None
    headers = make_message_type(header).store
    assert headers is not None
    converted = LimitedStore()
    converted.register({**store.fielddefs, _HEADER: headers.fielddefs[_HEADER]})
    return converted


def _convert(source: MessageType, store: Typestore, raw: bytes) -> bytes:
    # The conversion follows the lengths in a message without limits, which this checks.
    source.deserialize(raw)
    return bytes(store.ros1_to_cdr(raw, source.name))

"""Message types of ROS 2 as cyclonedds needs them to subscribe; messages stay as they are serialised."""

import re
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

_MANGLED = re.compile(r"(\w+)::msg::dds_::(\w+)_")


class SerializedSample:
    """A sample in place of its content: what cyclonedds calls to deserialise one."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        """CDR with its header of 4 bytes, as MCAP stores it; empty for the end of an instance."""
        self.sample_info: Any = None

    @classmethod
    def deserialize(cls, data: bytes) -> "SerializedSample":
        """Keeps the bytes."""
        return cls(data)

    @classmethod
    def deserialize_key(cls, data: bytes) -> "SerializedSample":  # noqa: ARG003
        """No key is needed."""
        return cls(b"")


def ros_type_name(dds_name: str) -> str | None:
    """``sensor_msgs/msg/Image`` of ``sensor_msgs::msg::dds_::Image_``; None if it is no message of ROS 2."""
    match = _MANGLED.fullmatch(dds_name)
    return f"{match[1]}/msg/{match[2]}" if match else None


def dds_topic_name(topic: str, namespace: str = "") -> str:
    """``rt/robot/scan`` of ``/scan`` in the namespace ``robot``."""
    return "/".join(part for part in ("rt", namespace.strip("/"), topic.strip("/")) if part)


@cache
def make_dds_type(name: str) -> Any:
    """The class by which cyclonedds knows a type that rosbags defines for ROS 2 Humble."""
    from cyclonedds.idl import make_idl_struct

    package, _, base = name.split("/")
    fields = {
        field: _field_type(kind) for field, kind in get_typestore(Stores.ROS2_HUMBLE).fielddefs[name][1]
    }  # fmt: skip
    return make_idl_struct(f"{base}_", f"{package}.msg.dds_.{base}_", fields)


def _field_type(kind: Any) -> Any:
    from cyclonedds.idl import types

    node, content = kind
    if node == Nodetype.NAME:
        return make_dds_type(content)
    if node == Nodetype.BASE:
        plain = {"bool": bool, "string": str, "octet": types.uint8, "byte": types.uint8, "char": types.uint8}
        return plain.get(content[0]) or getattr(types, content[0])
    array: Any = types.array
    sequence: Any = types.sequence
    inner, length = _field_type(content[0]), content[1]
    if node == Nodetype.ARRAY:
        return array[inner, length]
    return sequence[inner, length] if length else sequence[inner]

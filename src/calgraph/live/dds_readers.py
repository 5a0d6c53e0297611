"""Readers of the topics of a ROS 2 domain, made when something publishes them."""

import re
from collections.abc import Callable, Collection, Iterator
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from calgraph.errors import InputError
from calgraph.live.source import Channel, LiveMessage, Notice
from calgraph.recording.message_types import ros2_definition

Event = LiveMessage | Notice | Channel
"""A message, a notice, or a topic that is subscribed."""

# Samples of a topic, or publishers, that are taken by one call.
_MAX_TAKEN = 64


class DdsReaders:
    """Reads topics of a domain; all methods are called by one thread at a time.

    Raises:
        InputError: the domain cannot be joined.
    """

    def __init__(self, topics: Collection[str], domain: int, namespace: str) -> None:
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.domain import DomainParticipant

        self._topics = {dds_topic_name(topic, namespace): topic for topic in topics}
        self._mask = ViewState.Any | SampleState.Any | InstanceState.Any
        self._alive = InstanceState.Alive
        try:
            self._participant = DomainParticipant(domain)
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waits = WaitSet(self._participant)
            self._waits.attach(ReadCondition(self._publications, self._mask))
        except DDSException as error:
            raise InputError(
                f"domain {domain} of ROS 2 cannot be joined: {error}; check CYCLONEDDS_URI"
            ) from error
        self._writers: dict[str, dict[Any, Any]] = {}
        """By topic and identity: the quality of service that is offered."""
        self._readers: dict[str, tuple[Channel, Any, Any, Any]] = {}
        """By topic: its channel, quality of service, reader and condition."""
        self._unreadable: set[tuple[str, str]] = set()

    def read(self, timeout: float, clock: Callable[[], int]) -> Iterator[Event]:
        """What has arrived, after waiting for it for at most a time (s); the clock is that of arrivals (ns)."""
        self._waits.wait(round(timeout * 1e9))
        yield from self._discover()
        for channel, _, reader, _ in list(self._readers.values()):
            for sample in reader.take(N=_MAX_TAKEN):
                if isinstance(sample, SerializedSample) and sample.data:
                    yield LiveMessage(channel, clock(), sample.data)
            if lost := reader.get_sample_lost_status().total_count_change:
                text = f"{channel.topic}: DDS lost messages: the network is slow, or the computer"
                yield Notice("lost", text, channel.topic, lost)

    def close(self) -> None:
        """Leaves the domain."""
        self._readers.clear()
        del self._waits, self._publications, self._participant

    def _discover(self) -> Iterator[Event]:
        for one in self._publications.take(N=_MAX_TAKEN):
            if one.sample_info.instance_state != self._alive:
                for writers in self._writers.values():
                    writers.pop(one.key, None)
                continue
            topic = self._topics.get(one.topic_name)
            if topic is None:
                continue
            name = ros_type_name(one.type_name)
            definition = ros2_definition(name) if name else None
            if name is None or definition is None:
                if (topic, one.type_name) not in self._unreadable:
                    self._unreadable.add((topic, one.type_name))
                    text = f"{topic}: messages of type {one.type_name} cannot be read: ROS 2 does not define it"
                    yield Notice("missing", text, topic)
                continue
            self._writers.setdefault(topic, {})[one.key] = one.qos
            channel = Channel(topic, name, "cdr", "ros2msg", definition.text)
            if topic not in self._readers:
                yield channel
            self._subscribe(channel, one.topic_name)

    def _subscribe(self, channel: Channel, dds_topic: str) -> None:
        """Makes the reader of a topic, or one that asks for less where a writer offers less."""
        from cyclonedds.core import Policy, Qos, ReadCondition
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        offered = list(self._writers[channel.topic].values())
        reliable = all(qos[Policy.Reliability] != Policy.Reliability.BestEffort for qos in offered)
        latched = all(qos[Policy.Durability] != Policy.Durability.Volatile for qos in offered)
        quality = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0) if reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(_MAX_TAKEN),
        )
        if channel.topic in self._readers:
            before, asked, _, condition = self._readers[channel.topic]
            if asked == quality:
                return
            self._waits.detach(condition)
            del self._readers[channel.topic]
            channel = before
        topic = Topic(self._participant, dds_topic, make_dds_type(channel.type))
        topic.data_type = SerializedSample
        reader = DataReader(self._participant, topic, qos=quality)
        condition = ReadCondition(reader, self._mask)
        self._waits.attach(condition)
        self._readers[channel.topic] = channel, quality, reader, condition


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

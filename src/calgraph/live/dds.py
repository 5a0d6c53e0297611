"""A live source that is ROS 2 itself: DDS through cyclonedds, without an installation of ROS."""

import asyncio
import math
import os
import re
import threading
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from contextlib import suppress
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import ConnectionSettings
from calgraph.errors import InputError
from calgraph.live.source import Channel, LiveMessage, Notice
from calgraph.live.topic_watch import TopicWatch
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


_ADDRESS = re.compile(r"ros2:(?://(\d{0,3})(?:/([\w/]*))?)?")
# Domains whose ports exist (DDSI-RTPS, section 9.6.1.1).
_MAX_DOMAIN = 232
# The time for which a thread waits for samples before it looks whether it is to end, s.
_WAIT = 0.1


class DdsSource:
    """The topics of a ROS 2 domain.

    Args:
        address: ``ros2:``, or ``ros2://DOMAIN/NAMESPACE``. Without a number the domain is that of ROS_DOMAIN_ID,
            or 0. Topics keep their names of rig.yaml, without the namespace.
        settings: of connections.

    Raises:
        InputError: the address is malformed, or cyclonedds is not installed.
    """

    max_lead = math.inf

    def __init__(self, address: str, settings: ConnectionSettings) -> None:
        match = _ADDRESS.fullmatch(address)
        number = (match and match[1]) or os.environ.get("ROS_DOMAIN_ID") or "0"
        if not match or not number.isdecimal() or int(number) > _MAX_DOMAIN:
            raise InputError(
                f"{address}: is no address of ROS 2 (domain {number}): give ros2: or ros2://DOMAIN/NAMESPACE with "
                f"a domain from 0 to {_MAX_DOMAIN}"
            )
        try:
            import cyclonedds.domain  # noqa: F401  # only whether it is there
        except ImportError as error:
            raise InputError(
                f"{address}: ROS 2 needs cyclonedds, which is not installed: pip install 'calgraph[ros2]'"
            ) from error
        self.name, self._settings = address, settings
        self._domain, self._namespace = int(number), match[2] or ""

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice | None]:
        """Messages of the topics wanted, and notices; see :meth:`Source.stream`. Never ends by itself.

        Raises:
            InputError: the domain cannot be joined.
        """
        settings, loop = self._settings, asyncio.get_running_loop()
        events: asyncio.Queue[Event] = asyncio.Queue()
        waiting = 0

        def receive(event: Event) -> None:
            """Has an event wait to be taken; messages that do not fit are counted."""
            nonlocal waiting
            size = len(event.data) if isinstance(event, LiveMessage) else 0
            if isinstance(event, LiveMessage) and waiting + size > settings.max_queue_bytes:
                topic = event.channel.topic
                watch.note(Notice("lost", f"{topic}: messages arrive faster than they are recorded", topic, 1))
                return
            waiting += size
            events.put_nowait(event)

        readers = await asyncio.to_thread(DdsReaders, topics, self._domain, self._namespace)
        stop = threading.Event()

        thread = threading.Thread(
            target=_read,
            args=(readers, lambda event: loop.call_soon_threadsafe(receive, event), stop),
            daemon=True,
        )
        where = f"in domain {self._domain} of ROS 2"
        watch = TopicWatch(topics, settings, loop.time(), lambda topic: f"{topic}: nothing publishes it {where}")
        present: set[str] = set()
        next_notices = loop.time() + _WAIT
        thread.start()
        try:
            yield Notice("connected", f"joined domain {self._domain} of ROS 2")
            while True:
                with suppress(TimeoutError):
                    async with asyncio.timeout(_WAIT):
                        event = await events.get()
                    if isinstance(event, Channel):
                        watch.start(event, loop.time())
                        present.add(event.topic)
                    elif isinstance(event, Notice):
                        if event.kind == "ended":
                            yield event
                            return
                        watch.note(event)
                        present |= {event.topic} if event.topic else set()
                    else:
                        waiting -= len(event.data)
                        watch.observe(event, loop.time())
                        yield event
                if loop.time() >= next_notices:
                    next_notices = loop.time() + _WAIT
                    for notice in watch.take_notices(loop.time(), present):
                        yield notice
                    yield None
        finally:
            stop.set()
            await asyncio.to_thread(thread.join)


def _read(readers: DdsReaders, post: Callable[[Event], object], stop: threading.Event) -> None:
    """Reads until it is to stop; the function of a thread."""
    try:
        while not stop.is_set():
            for event in readers.read(_WAIT, time.time_ns):
                post(event)
    except Exception as error:  # the stream ends with its text
        post(Notice("ended", f"reading from DDS failed: {error}"))
    finally:
        readers.close()

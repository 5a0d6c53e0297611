"""Readers of the topics of a ROS 2 domain, made when something publishes them."""

from collections.abc import Callable, Collection, Iterator
from typing import Any

from calgraph.errors import InputError
from calgraph.live.dds_types import SerializedSample, dds_topic_name, make_dds_type, ros_type_name
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

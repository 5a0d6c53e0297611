"""What a source notices about topics from their messages: gaps between stamps, and silence."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from rosbags.interfaces import MessageDefinitionFormat

from calgraph.config.settings import ConnectionSettings
from calgraph.live.source import Channel, LiveMessage, Notice
from calgraph.recording.message_types import MessageType, TypeDefinition, make_message_type
from calgraph.sensors.kinds import SENSOR_TYPES


@dataclass
class _Topic:
    """The state of one topic."""

    last_time: float
    """Of its last message, or of the subscription; s of the caller's clock."""
    kind: MessageType | None = None
    """Of a sensor's messages."""
    received: bool = False
    silent: bool = False
    last_stamp: int | None = None
    intervals: deque[int] = field(default_factory=deque)


# Number of last messages of a sensor whose stamps state its usual interval: their median.
_USUAL_INTERVALS = 20
# Minimum ratio of a time between two stamps to the usual interval for the messages between to count as lost:
# drivers skip single ones without any fault.
_GAP_RATIO = 3.5
# Minimum time between two such stamps, s: stamps of fast sensors vary by the scheduling of computers.
_MIN_GAP = 0.05


class TopicWatch:
    """Watches the topics that a source is subscribed to.

    Only of sensors, which measure at a constant rate, it knows how many messages are missing.
    """

    def __init__(self, settings: ConnectionSettings) -> None:
        self._settings = settings
        self._topics: dict[str, _Topic] = {}

    def start(self, channel: Channel, now: float) -> None:
        """Watches a topic from now on."""
        kind = _find_sensor_type(channel)
        intervals: deque[int] = deque(maxlen=_USUAL_INTERVALS)
        self._topics[channel.topic] = _Topic(now, kind, intervals=intervals)

    def stop(self, topic: str) -> None:
        """Does not watch a topic any more."""
        self._topics.pop(topic, None)

    def observe(self, message: LiveMessage, now: float) -> Notice | None:
        """Takes note of a message; messages that are missing before it, if any."""
        topic = self._topics[message.channel.topic]
        topic.last_time, topic.received, topic.silent = now, True, False
        if topic.kind is None:
            return None
        stamp, before = _stamp(topic.kind, message), topic.last_stamp
        topic.last_stamp = stamp
        if before is None or stamp <= before:
            return None
        usual = self._usual_interval(topic)
        topic.intervals.append(stamp - before)
        if usual is None or stamp - before < max(_GAP_RATIO * usual, _MIN_GAP * 1e9):
            return None
        missing = round((stamp - before) / usual) - 1
        name = message.channel.topic
        return Notice(
            "lost",
            f"{name}: {missing} messages are missing: none for {(stamp - before) / 1e9:.2f} s, where one each "
            f"{usual / 1e9:.3f} s is usual. The sensor, the network or the server dropped them",
            name,
            missing,
        )

    def find_silent(self, now: float) -> Iterator[Notice]:
        """The topics that have become silent: those without any message, and sensors that stopped."""
        for name, topic in self._topics.items():
            usual = self._usual_interval(topic)
            regular = not topic.received or usual is not None
            limit = max(self._settings.silence, _GAP_RATIO * (usual or 0) / 1e9)
            if regular and not topic.silent and now - topic.last_time >= limit:
                topic.silent = True
                yield Notice("missing", f"{name}: no message for {now - topic.last_time:.0f} s", name)

    def _usual_interval(self, topic: _Topic) -> int | None:
        """The usual time between two stamps, ns; None where it is not known or not constant.

        One interval may be longer, by messages that are missing.
        """
        if len(topic.intervals) < _USUAL_INTERVALS:
            return None
        ordered = sorted(topic.intervals)
        median = ordered[len(ordered) // 2]
        return median if ordered[-2] < _GAP_RATIO * median else None


class StampReader:
    """Reads stamps of sensors' messages."""

    def __init__(self) -> None:
        self._kinds: dict[Channel, MessageType | None] = {}

    def read(self, message: LiveMessage) -> int | None:
        """The header's stamp, ns; None of other messages, and of headers without one."""
        if message.channel not in self._kinds:
            self._kinds[message.channel] = _find_sensor_type(message.channel)
        kind = self._kinds[message.channel]
        if kind is None:
            return None
        try:
            return kind.header_stamp(message.data) or None
        except Exception:  # damaged: the decoder states why
            return None


def _find_sensor_type(channel: Channel) -> MessageType | None:
    """The type of a sensor's messages; None of others."""
    return make_message_type(_definition(channel)) if channel.type in SENSOR_TYPES else None


def _stamp(kind: MessageType, message: LiveMessage) -> int:
    """The header's stamp, or the arrival, ns."""
    try:
        return kind.header_stamp(message.data) or message.arrival
    except Exception:  # damaged: the decoder states why
        return message.arrival


def _definition(channel: Channel) -> TypeDefinition:
    idl = channel.schema_format == "ros2idl"
    text_format = MessageDefinitionFormat.IDL if idl else MessageDefinitionFormat.MSG
    return TypeDefinition(channel.type, text_format, channel.schema, channel.encoding)

"""The Foxglove WebSocket protocol without its connection: what frames of a server mean, and what to send.

Both subprotocols, ``foxglove.websocket.v1`` of ros-foxglove-bridge and ``foxglove.sdk.v1`` of the Foxglove SDK,
have the frames that are read here. Source: https://github.com/foxglove/ws-protocol, docs/spec.md.
"""

import json
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, get_args

from rosbags.typesys.msg import normalize_msgtype

from calgraph.config.settings import ConnectionSettings
from calgraph.live.notice_limiter import NoticeLimiter
from calgraph.live.source import Channel, Encoding, LiveMessage, Notice, SchemaFormat
from calgraph.live.topic_watch import TopicWatch
from calgraph.recording.recording import explain_missing_topic

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_MESSAGE_DATA = 1
_DATA_HEADER = struct.Struct("<BIQ")  # opcode, subscription, time of receipt in ns
# Time, service responses, assets and the state of a playback: nothing of use here.
_OTHER_OPCODES = (2, 3, 4, 5)
# Bridges of large robots advertise 500 topics with some 5 KB of definitions each; parsing takes a multiple.
_MAX_TEXT_BYTES = 2**24
_SCHEMA_FORMATS: dict[Encoding, tuple[SchemaFormat, ...]] = {"cdr": ("ros2msg", "ros2idl"), "ros1": ("ros1msg",)}
_WARNING = 1


@dataclass(frozen=True)
class _Advertised:
    """A channel as a server advertises it."""

    topic: str
    channel: Channel | None
    """None if its messages cannot be read."""
    problem: str = ""
    """Why not."""


class FoxgloveClient:
    """One connection's state.

    Args:
        topics: wanted.
        settings: of connections.
        now: time of the connection, s; all times are of one clock.
    """

    def __init__(self, topics: Collection[str], settings: ConnectionSettings, now: float) -> None:
        self._topics = tuple(topics)
        pass
        self._discovery_end = now + settings.discovery_time
        self._discovered = False
        self._advertised: dict[int, _Advertised] = {}
        self._subscriptions: dict[int, tuple[int, Channel] | None] = {}
        """By number: number and content of the channel; None once it has ended."""
        self._watch = TopicWatch(settings)
        self._notices = NoticeLimiter(settings.notice_interval)
        self._requests: list[str] = []

    def receive(self, frame: str | bytes, now: float) -> LiveMessage | None:
        """The message in a frame, if it has one."""
        if isinstance(frame, bytes):
            return self._receive_binary(frame, now)
        try:
            self._receive_text(frame, now)
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            self._refuse(f"a text frame is malformed ({type(error).__name__})")
        return None

    def take_requests(self) -> list[str]:
        """The frames to send by now."""
        requests, self._requests = self._requests, []
        return requests

    def take_notices(self, now: float) -> Iterator[Notice]:
        """The notices by now."""
        if not self._discovered and now >= self._discovery_end:
            self._discovered = True
            present = sorted({one.topic for one in self._advertised.values()})
            for topic in self._topics:
                if topic not in present:
                    self._notices.add("missing", f"the server {explain_missing_topic(topic, present)}", topic)
        for silent in self._watch.find_silent(now):
            self._notices.add(silent.kind, silent.text, silent.topic)
        return self._notices.take(now)

    def _receive_binary(self, frame: bytes, now: float) -> LiveMessage | None:
        if len(frame) < _DATA_HEADER.size or frame[0] != _MESSAGE_DATA:
            if not frame or frame[0] not in _OTHER_OPCODES:
                self._refuse(f"a binary frame of {len(frame)} bytes is malformed")
            return None
        _, number, arrival = _DATA_HEADER.unpack_from(frame)
        if number not in self._subscriptions:
            self._refuse(f"a message is of the subscription {number}, which does not exist")
            return None
        subscription = self._subscriptions[number]
        if subscription is None:
            return None  # sent before the server knew that the channel is not wanted any more
        message = LiveMessage(subscription[1], arrival, frame[_DATA_HEADER.size :])
        if lost := self._watch.observe(message, now):
            self._notices.add(lost.kind, lost.text, lost.topic, lost.count)
        return message

    def _receive_text(self, frame: str, now: float) -> None:
        if len(frame) > _MAX_TEXT_BYTES:
            raise ValueError("too long")
        content: Any = json.loads(frame)
        match content["op"]:
            case "advertise":
                for described in content["channels"]:
                    self._advertise(described)
                self._subscribe(now)
            case "unadvertise":
                for number in content["channelIds"]:
                    self._unadvertise(number)
                self._subscribe(now)
            case "status":
                self._report_status(content["level"], content["message"])

    def _advertise(self, described: Any) -> None:
        number, topic, encoding = described["id"], described["topic"], described["encoding"]
        if not isinstance(number, int) or not isinstance(topic, str):
            raise TypeError("id and topic")
        if topic not in self._topics:
            # Kept by name only: an answer to a missing topic lists what there is.
            self._advertised[number] = _Advertised(topic, None)
            return
        formats: tuple[SchemaFormat, ...] = _SCHEMA_FORMATS.get(encoding, ())
        schema_format = described.get("schemaEncoding") or (formats[0] if formats else "none")
        name, schema = described["schemaName"], described["schema"]
        if not isinstance(name, str) or not isinstance(schema, str):
            raise TypeError("schemaName and schema")
        if schema_format not in formats:
            self._advertised[number] = _Advertised(
                topic, None, f"{name}, encoded as {encoding} with {schema_format}"
            )
            return
        channel = Channel(topic, normalize_msgtype(name), encoding, schema_format, schema)
        self._advertised[number] = _Advertised(topic, channel)

    def _subscribe(self, now: float) -> None:
        """Subscribes to the first readable channel of each wanted topic."""
        subscribed = {one[1].topic for one in self._subscriptions.values() if one}
        requests = []
        for topic in self._topics:
            channels = [(number, one) for number, one in self._advertised.items() if one.topic == topic]
            readable = [(number, one.channel) for number, one in channels if one.channel]
            if topic in subscribed or not channels:
                continue
            if not readable:
                self._notices.add(
                    "missing",
                    f"{topic} cannot be read: it is {channels[0][1].problem}. {_describe_readable()}: run the "
                    "foxglove_bridge of ROS, which serves these",
                    topic,
                )
                continue
            channel_id, channel = readable[0]
            number = len(self._subscriptions) + 1
            self._subscriptions[number] = channel_id, channel
            self._watch.start(channel, now)
            requests.append({"id": number, "channelId": channel_id})
        if requests:
            self._requests.append(json.dumps({"op": "subscribe", "subscriptions": requests}))

    def _unadvertise(self, channel_id: int) -> None:
        self._advertised.pop(channel_id, None)
        for number, subscription in self._subscriptions.items():
            if subscription and subscription[0] == channel_id:
                topic = subscription[1].topic
                self._subscriptions[number] = None
                self._watch.stop(topic)
                self._notices.add("missing", f"the server does not serve {topic} any more", topic)

    def _report_status(self, level: int, message: str) -> None:
        """Warnings and errors of the server; that of a full buffer does not state how many messages are lost."""
        if level >= _WARNING:
            dropped = "drop" in message.lower()
            self._notices.add("lost" if dropped else "refused", f"the server reports: {message}")

    def _refuse(self, text: str) -> None:
        self._notices.add("refused", text, count=1)


def _describe_readable() -> str:
    pairs = [f"{encoding} with {one}" for encoding in get_args(Encoding) for one in _SCHEMA_FORMATS[encoding]]
    return f"Messages are read as {', '.join(pairs)}"

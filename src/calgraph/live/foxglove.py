"""A live source that is a server of the Foxglove WebSocket protocol, as robots run for looking at their data."""

import asyncio
import errno
import json
import math
import os
import struct
import time
from collections.abc import AsyncIterator, Collection, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, get_args

from rosbags.typesys.msg import normalize_msgtype

from calgraph.config.settings import ConnectionSettings
from calgraph.errors import InputError
from calgraph.live.source import Channel, Encoding, LiveMessage, Notice, SchemaFormat, clean_text
from calgraph.live.topic_watch import TopicWatch
from calgraph.recording.recording import explain_missing_topic

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection, connect


# While no frame comes, time passes for silence and notices in steps of this, s.
_TICK = 0.25
# Frames that are received and not yet read; the connection is not read from while they wait.
_MAX_QUEUED_FRAMES = 16
# Why a client ends a connection (RFC 6455, section 7.4.1).
_REFUSALS = {
    1002: "a frame is malformed and ended the connection",
    1007: "a text frame is not UTF-8 and ended the connection",
    1009: "a frame is larger than the limit ({limit}) and ended the connection",
}


# Delay of the first attempt to connect again, s; it doubles with each further one.
_FIRST_DELAY = 0.5
# Maximum delay, s: an operator who has put a cable back waits no longer, and an attempt costs nothing.
_MAX_DELAY = 2.0
# Time between two questions whether the server is still there, s: without them, a robot that lost its power looks
# like one that has nothing to send.
_PING_INTERVAL = 2.0
# Time for the answer, s; behind the frames that a slow wireless link still carries it may take seconds.
_PING_TIMEOUT = 10.0


class FoxgloveSource:
    """A server of the Foxglove WebSocket protocol.

    Args:
        address: ``ws://HOST:PORT`` or ``wss://HOST:PORT``.
        settings: of connections.

    Raises:
        InputError: the address is malformed, or websockets is not installed.
    """

    max_lead = math.inf

    def __init__(self, address: str, settings: ConnectionSettings) -> None:
        try:
            from websockets.exceptions import InvalidURI
            from websockets.uri import parse_uri
        except ImportError as error:
            raise InputError(
                f"{address}: live sources need websockets, which is not installed: pip install 'calgraph[live]'"
            ) from error
        try:
            host = parse_uri(address).host
        except (InvalidURI, ValueError) as error:
            raise InputError(
                f"{address}: is no address ({error}): give ws://HOST:PORT or wss://HOST:PORT"
            ) from error
        if any(one.isspace() for one in host):
            raise InputError(f"{address}: is no address (spaces): give ws://HOST:PORT or wss://HOST:PORT")
        self.name, self._settings = address, settings

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice | None]:
        """Messages of the topics wanted, and notices; see :meth:`Source.stream`. Never ends by itself."""
        from websockets.exceptions import ConnectionClosed, WebSocketException

        settings, now = self._settings, asyncio.get_running_loop().time
        delay, problem = _FIRST_DELAY, ""
        last_receipt: float | None = None
        while True:
            try:
                async with self._connect() as connection:
                    _check_protocol(connection)
                    yield Notice("connected", self._describe_connection(last_receipt))
                    problem, last_receipt = "", time.time()
                    client = FoxgloveClient(topics, settings, now())
                    next_notices = now() + _TICK
                    while True:
                        frame = await _receive_frame(connection)
                        if frame is not None and (message := client.receive(frame, now())):
                            delay, last_receipt = _FIRST_DELAY, time.time()
                            yield message
                        for request in client.take_requests():
                            # A connection that has ended still has frames to read.
                            with suppress(ConnectionClosed):
                                await connection.send(request)
                        if now() >= next_notices:
                            next_notices = now() + _TICK
                            for notice in client.take_notices(now()):
                                yield notice
                            yield None
            except ConnectionClosed as error:
                if error.sent and error.sent.code in _REFUSALS:
                    yield Notice("refused", self._explain_refusal(error.sent.code), count=1)
                reason = "the connection broke"
            except (OSError, WebSocketException) as error:
                # asyncio has other texts for errors of the system; those of names have negative numbers.
                number = getattr(error, "errno", None) or 0
                reason = os.strerror(number).lower() if number > 0 else str(error) or "no answer"
                if number == errno.ECONNREFUSED:
                    reason += ": no bridge listens at this port; start foxglove_bridge, or state its port"
            if reason != problem:
                problem = reason
                yield Notice("disconnected", clean_text(f"{self.name}: {reason}; trying again"))
            await asyncio.sleep(delay)
            delay = min(2 * delay, _MAX_DELAY)

    def _connect(self) -> "connect":
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        settings = self._settings
        return connect(
            self.name,
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            # Sensor data hardly shrink, and local networks are faster than compression.
            compression=None,
            max_size=settings.max_frame_bytes,
            max_queue=_MAX_QUEUED_FRAMES,
            open_timeout=settings.open_timeout,
            ping_interval=_PING_INTERVAL,
            ping_timeout=_PING_TIMEOUT,
            # Robots are reached directly, also where the environment names a proxy for the Internet.
            proxy=None,
        )

    def _describe_connection(self, last_receipt: float | None) -> str:
        if last_receipt is None:
            return f"connected to {self.name}"
        begin, end = (time.strftime("%H:%M:%S", time.localtime(at)) for at in (last_receipt, time.time()))
        gap = time.time() - last_receipt
        return f"connected to {self.name} again; nothing was received for {gap:.1f} s, from {begin} to {end}"

    def _explain_refusal(self, code: int) -> str:
        limit = self._settings.max_frame_bytes / 1e6
        return _REFUSALS[code].format(limit=f"{limit:.3g} MB, settings.live.connection.max_frame_bytes")


async def _receive_frame(connection: "ClientConnection") -> str | bytes | None:
    """The next frame; None if none comes for some time."""
    try:
        async with asyncio.timeout(_TICK):
            return await connection.recv()
    except TimeoutError:
        return None


def _check_protocol(connection: "ClientConnection") -> None:
    """Checks that the server has chosen one of the protocols.

    Raises:
        ConnectionError: it has not.
    """
    if connection.subprotocol is None:
        raise ConnectionError(
            f"it speaks neither {' nor '.join(SUBPROTOCOLS)}: give the port of a Foxglove bridge"
        )


SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_MESSAGE_DATA = 1
_DATA_HEADER = struct.Struct("<BIQ")  # opcode, subscription, time of receipt in ns
# Time, service responses, assets and the state of a playback: nothing of use here.
_OTHER_OPCODES = (2, 3, 4, 5)
# Bridges of large robots advertise 500 topics with some 5 KB of definitions each; parsing takes a multiple.
_MAX_TEXT_BYTES = 2**24
_SCHEMA_FORMATS: dict[Encoding, tuple[SchemaFormat, ...]] = {"cdr": ("ros2msg", "ros2idl"), "ros1": ("ros1msg",)}
_WARNING = 1


class FoxgloveClient:
    """One connection's state.

    Args:
        topics: wanted.
        settings: of connections.
        now: time of the connection, s; all times are of one clock.
    """

    def __init__(self, topics: Collection[str], settings: ConnectionSettings, now: float) -> None:
        self._topics = tuple(topics)
        self._advertised: dict[int, tuple[str, Channel | str]] = {}
        """By number: the topic, and the channel or why it is not read."""
        self._subscriptions: dict[int, tuple[int, Channel] | None] = {}
        """By number: number and content of the channel; None once it has ended."""
        self._watch = TopicWatch(topics, settings, now, self._explain_missing)
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
        return self._watch.take_notices(now, self._list_present())

    def _list_present(self) -> list[str]:
        return sorted({topic for topic, _ in self._advertised.values()})

    def _explain_missing(self, topic: str) -> str:
        return f"the server {explain_missing_topic(topic, self._list_present())}"

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
        self._watch.observe(message, now)
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
            self._advertised[number] = topic, "not wanted"
            return
        formats: tuple[SchemaFormat, ...] = _SCHEMA_FORMATS.get(encoding, ())
        schema_format = described.get("schemaEncoding") or (formats[0] if formats else "none")
        name, schema = described["schemaName"], described["schema"]
        if not isinstance(name, str) or not isinstance(schema, str):
            raise TypeError("schemaName and schema")
        if schema_format not in formats:
            self._advertised[number] = topic, f"{name}, encoded as {encoding} with {schema_format}"
            return
        self._advertised[number] = topic, Channel(topic, normalize_msgtype(name), encoding, schema_format, schema)

    def _subscribe(self, now: float) -> None:
        """Subscribes to the first readable channel of each wanted topic."""
        subscribed = {one[1].topic for one in self._subscriptions.values() if one}
        requests = []
        for topic in self._topics:
            channels = {number: channel for number, (name, channel) in self._advertised.items() if name == topic}
            readable = [(number, one) for number, one in channels.items() if isinstance(one, Channel)]
            if topic in subscribed or not channels:
                continue
            if not readable:
                text = (
                    f"{topic} cannot be read: it is {next(iter(channels.values()))}. {_describe_readable()}: run "
                    "the foxglove_bridge of ROS, which serves these"
                )
                self._watch.note(Notice("missing", text, topic))
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
                self._watch.note(Notice("missing", f"the server does not serve {topic} any more", topic))

    def _report_status(self, level: int, message: str) -> None:
        """Warnings and errors of the server; that of a full buffer does not state how many messages are lost."""
        if level >= _WARNING:
            dropped = "drop" in message.lower()
            self._watch.note(Notice("lost" if dropped else "refused", f"the server reports: {message}"))

    def _refuse(self, text: str) -> None:
        self._watch.note(Notice("refused", text, count=1))


def _describe_readable() -> str:
    pairs = [f"{encoding} with {one}" for encoding in get_args(Encoding) for one in _SCHEMA_FORMATS[encoding]]
    return f"Messages are read as {', '.join(pairs)}"

"""Servers of the Foxglove protocol as live sources: the SDK's, and one of the older protocol."""

import asyncio
import json
import struct
from collections.abc import Iterator
from typing import Any

import foxglove
import pytest
from foxglove.websocket import ChannelView, Client, ServerListener
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.asyncio.server import ServerConnection

from calgraph.config.settings import ConnectionSettings, Settings
from calgraph.errors import InputError
from calgraph.live.foxglove import FoxgloveSource
from calgraph.live.open_source import open_source
from calgraph.live.source import LiveMessage, Notice
from collected_sources import messages, notices
from foxglove_servers import (
    HEADER,
    ROS1,
    ROS2,
    SCAN,
    advertise,
    channel,
    data_frame,
    foxglove_server,
    header_bytes,
    subscriptions,
    until,
)

OLD_SCAN = "sensor_msgs/LaserScan"
"""As ROS 1 names it."""
FAST = ConnectionSettings(discovery_time=0.05, notice_interval=0)


@pytest.fixture(autouse=True)
def reconnect_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections are tried again within 20 ms."""
    monkeypatch.setattr("calgraph.live.foxglove._FIRST_DELAY", 0.01)
    monkeypatch.setattr("calgraph.live.foxglove._MAX_DELAY", 0.02)


def count(kind: str, number: int) -> Any:
    """Whether there are this many messages, or notices of a kind."""

    def enough(given: list[LiveMessage | Notice]) -> bool:
        if kind == "message":
            return len(messages(given)) >= number
        return len([one for one in notices(given) if one.kind == kind]) >= number

    return enough


def only(given: list[LiveMessage | Notice], kind: str) -> list[Notice]:
    return [one for one in notices(given) if one.kind == kind]


class SdkServer(ServerListener):
    """The Foxglove SDK's server."""

    def __init__(self, port: int = 0) -> None:
        self.context = foxglove.Context()
        self.subscribed = 0
        self.server = foxglove.start_server(
            host="127.0.0.1", port=port, context=self.context, server_listener=self, message_backlog_size=1000
        )
        self.address = f"ws://127.0.0.1:{self.server.port}"

    def channel(self, topic: str, type_name: str) -> foxglove.Channel:
        text, _ = ROS2.generate_msgdef(type_name, ros_version=2)
        schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=text.encode())
        return foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=self.context)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        self.subscribed += 1

    async def wait_for_subscriptions(self, number: int) -> None:
        async with asyncio.timeout(60):
            while self.subscribed < number:
                await asyncio.sleep(0.005)


@pytest.fixture
def sdk() -> Iterator[SdkServer]:
    server = SdkServer()
    yield server
    server.server.stop()


def test_the_sdk_server_sends_every_message_as_it_was_logged(sdk: SdkServer) -> None:
    triggers, scans = sdk.channel("/trigger", HEADER), sdk.channel("/scan", SCAN)
    sdk.channel("/other", HEADER)
    sent = [header_bytes(k) for k in range(200)]

    async def run() -> list[LiveMessage | Notice]:
        source = open_source(sdk.address, Settings())
        received = asyncio.create_task(until(source, ["/trigger", "/scan"], count("message", 201)))
        await sdk.wait_for_subscriptions(2)
        for k, content in enumerate(sent):
            triggers.log(content, log_time=1_700_000_000_000_000_000 + k)
        scans.log(b"a scan", log_time=1_700_000_001_000_000_000)
        return await received

    given = messages(asyncio.run(run()))
    of_triggers = [one for one in given if one.channel.topic == "/trigger"]
    assert [one.data for one in of_triggers] == sent
    assert [one.arrival for one in of_triggers] == [1_700_000_000_000_000_000 + k for k in range(200)]
    described = of_triggers[0].channel
    assert (described.type, described.encoding, described.schema_format) == (HEADER, "cdr", "ros2msg")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(described.schema, described.type))
    content: Any = store.deserialize_cdr(of_triggers[7].data, HEADER)
    assert content.stamp.sec == 7


def test_a_channel_that_appears_later_is_subscribed(sdk: SdkServer) -> None:
    async def run() -> list[LiveMessage | Notice]:
        source = FoxgloveSource(sdk.address, FAST)
        received = asyncio.create_task(until(source, ["/trigger"], count("message", 1)))
        await asyncio.sleep(0.1)
        late = sdk.channel("/trigger", HEADER)
        await sdk.wait_for_subscriptions(1)
        late.log(header_bytes(1.0))
        return await received

    assert len(messages(asyncio.run(run()))) == 1


def test_a_server_that_comes_back_is_connected_again_and_the_gap_is_named() -> None:
    async def run() -> list[LiveMessage | Notice]:
        first = SdkServer()
        triggers = first.channel("/trigger", HEADER)
        source = FoxgloveSource(first.address, FAST)
        arrived, both = asyncio.Event(), count("message", 2)

        def enough(given: list[LiveMessage | Notice]) -> bool:
            if messages(given):
                arrived.set()
            return bool(both(given))

        received = asyncio.create_task(until(source, ["/trigger"], enough))
        await first.wait_for_subscriptions(1)
        triggers.log(header_bytes(1.0))
        # A server that stops does not send what it has not sent yet.
        await arrived.wait()
        port = first.server.port
        await asyncio.to_thread(first.server.stop)
        await asyncio.sleep(0.2)
        second = SdkServer(port)
        triggers = second.channel("/trigger", HEADER)
        await second.wait_for_subscriptions(1)
        triggers.log(header_bytes(2.0))
        given = await received
        await asyncio.to_thread(second.server.stop)
        return given

    given = asyncio.run(run())
    kinds = [one.kind if isinstance(one, Notice) else "message" for one in given]
    assert kinds[:2] == ["connected", "message"]
    assert kinds[-2:] == ["connected", "message"]
    assert "disconnected" in kinds
    again = only(given, "connected")[-1].text
    assert "again; nothing was received for 0." in again or "again; nothing was received for 1." in again


@pytest.mark.parametrize(
    ("described", "type_name", "schema_format", "encoding"),
    [
        (channel(3, "/scan", SCAN, schemaEncoding=None), SCAN, "ros2msg", "cdr"),
        (channel(3, "/scan", SCAN, schemaEncoding="ros2idl"), SCAN, "ros2idl", "cdr"),
        (channel(3, "/scan", OLD_SCAN, encoding="ros1", schemaEncoding=None), SCAN, "ros1msg", "ros1"),
        (channel(3, "/scan", OLD_SCAN, encoding="ros1", schemaEncoding="ros1msg"), SCAN, "ros1msg", "ros1"),
    ],
)  # fmt: skip
def test_the_older_bridge_serves_ros1_and_ros2(
    described: dict[str, Any], type_name: str, schema_format: str, encoding: str
) -> None:
    async def talk(connection: ServerConnection) -> None:
        assert connection.subprotocol == "foxglove.websocket.v1"
        await connection.send(advertise(channel(1, "/other"), described))
        numbers = await subscriptions(connection)
        assert list(numbers) == [3]
        await connection.send(data_frame(numbers[3], 12345, b"content"))
        await connection.wait_closed()

    async def run() -> list[LiveMessage | Notice]:
        async with foxglove_server(talk) as address:
            return await until(FoxgloveSource(address, FAST), ["/scan"], count("message", 1))

    (message,) = messages(asyncio.run(run()))
    assert (message.arrival, message.data) == (12345, b"content")
    assert message.channel.type == type_name
    assert (message.channel.schema_format, message.channel.encoding) == (schema_format, encoding)


def receive(
    *frames: str | bytes, topics: tuple[str, ...] = ("/trigger",), enough: Any, settings: ConnectionSettings = FAST
) -> list[LiveMessage | Notice]:
    """What a client makes of frames that a server sends one after the other."""

    async def talk(connection: ServerConnection) -> None:
        for frame in frames:
            await connection.send(frame)
        await connection.wait_closed()

    async def run() -> list[LiveMessage | Notice]:
        async with foxglove_server(talk) as address:
            return await until(FoxgloveSource(address, settings), list(topics), enough)

    return asyncio.run(run())


def test_a_topic_in_another_encoding_is_missing_with_what_can_be_read() -> None:
    described = channel(1, "/trigger", "foxglove.Log", encoding="protobuf", schemaEncoding="protobuf")
    (missing,) = only(receive(advertise(described), enough=count("missing", 1)), "missing")
    assert missing.topic == "/trigger"
    assert "it is foxglove.Log, encoded as protobuf with protobuf" in missing.text
    assert "cdr with ros2msg, cdr with ros2idl, ros1 with ros1msg" in missing.text


def test_of_two_channels_of_a_topic_the_readable_one_is_subscribed() -> None:
    in_json = channel(1, "/trigger", encoding="json", schemaEncoding="jsonschema")
    given = receive(advertise(in_json, channel(2, "/trigger")), data_frame(1, 5, b"x"), enough=count("message", 1))
    assert messages(given)[0].channel.encoding == "cdr"
    assert only(given, "missing") == []


def test_a_topic_that_is_not_served_is_missing_with_its_likely_name() -> None:
    given = receive(advertise(channel(1, "/triggers")), enough=count("missing", 1))
    (missing,) = only(given, "missing")
    assert missing.topic == "/trigger"
    assert "did you mean '/triggers'?" in missing.text


def test_a_topic_that_is_served_no_more_is_missing_and_subscribed_when_it_returns() -> None:
    gone = json.dumps({"op": "unadvertise", "channelIds": [1]})
    given = receive(
        advertise(channel(1, "/trigger")), data_frame(1, 5, b"before"), gone, data_frame(1, 6, b"late"),
        advertise(channel(1, "/trigger")), data_frame(2, 7, b"after"),
        enough=lambda given: len(messages(given)) >= 2 and bool(only(given, "missing")),
    )  # fmt: skip
    assert [one.data for one in messages(given)] == [b"before", b"after"]
    assert "does not serve /trigger any more" in only(given, "missing")[0].text
    assert only(given, "refused") == []


MALFORMED: list[str | bytes] = [
    "not json", "[]", "3", "{}", '{"op": "advertise"}', '{"op": "advertise", "channels": [{"id": "a"}]}',
    '{"op": "advertise", "channels": [7]}', '{"op": "unadvertise", "channelIds": 4}',
    '{"op": "advertise", "channels": [{"id": 1, "topic": "/trigger", "encoding": []}]}',
    '{"op": "unadvertise", "channelIds": [[]]}', '{"op": "status", "level": "a", "message": "b"}',
    '{"op": "status", "level": 2, "message": 5}', "[" * 100_000, '{"op": {}, "a": ' + "[" * 5000,
    b"", b"\x01", b"\x01\x01\x00\x00\x00", b"\x00" + bytes(20), b"\xff" + bytes(40), data_frame(99, 5, b"unknown"),
]  # fmt: skip


@pytest.mark.parametrize("frame", MALFORMED, ids=lambda frame: repr(frame[:40]))
def test_a_malformed_frame_is_refused_and_the_next_message_is_received(frame: str | bytes) -> None:
    given = receive(
        advertise(channel(1, "/trigger")), frame, data_frame(1, 5, b"good"),
        enough=lambda given: messages(given) and only(given, "refused"),
    )  # fmt: skip
    assert [one.data for one in messages(given)] == [b"good"]
    assert sum(one.count for one in only(given, "refused")) == 1
    assert len(only(given, "connected")) == 1


def test_malformed_frames_are_counted_in_few_notices() -> None:
    slow = FAST.model_copy(update={"notice_interval": 0.3})
    frames = [b"\xff" * 20] * 5000
    given = receive(
        *frames, enough=lambda given: sum(one.count for one in only(given, "refused")) >= 5000, settings=slow
    )
    assert len(only(given, "refused")) < 500
    assert sum(one.count for one in only(given, "refused")) == 5000


def test_frames_of_no_use_here_are_no_errors() -> None:
    frames: list[str | bytes] = [
        struct.pack("<BQ", 2, 12345), b"\x03" + bytes(30), b"\x04" + bytes(30), '{"op": "parameterValues"}',
        '{"op": "advertiseServices", "services": []}', '{"op": "status", "level": 0, "message": "dropped by"}',
    ]  # fmt: skip
    given = receive(
        *frames, advertise(channel(1, "/trigger")), data_frame(1, 5, b"good"), enough=count("message", 1)
    )
    assert [one.kind for one in notices(given)] == ["connected"]


def test_an_oversized_frame_ends_the_connection_with_the_limit_named() -> None:
    small = FAST.model_copy(update={"max_frame_bytes": 10_000})
    given = receive(
        advertise(channel(1, "/trigger")), data_frame(1, 5, b"good"), data_frame(1, 6, bytes(20_000)),
        enough=count("connected", 2), settings=small,
    )  # fmt: skip
    (refused,) = only(given, "refused")
    assert "larger than the limit (0.01 MB, settings.live.connection.max_frame_bytes)" in refused.text
    assert refused.count == 1
    assert messages(given)[0].data == b"good"


def test_a_server_that_reports_a_full_buffer_has_lost_messages() -> None:
    text = "Connection send buffer limit reached, messages will be dropped..."
    status = json.dumps({"op": "status", "level": 1, "message": text})
    (lost,) = only(receive(status, enough=count("lost", 1)), "lost")
    assert text in lost.text


def test_missing_scans_are_counted_by_their_stamps() -> None:
    scans = [content for k in range(40) if not 25 <= k < 32 for content in [scan_bytes(100 + 0.1 * k)]]
    frames = [data_frame(1, 5 + k, content) for k, content in enumerate(scans)]
    given = receive(
        advertise(channel(1, "/scan", SCAN)), *frames, topics=("/scan",),
        enough=lambda given: len(messages(given)) == 33 and only(given, "lost"),
    )  # fmt: skip
    (lost,) = only(given, "lost")
    assert (lost.topic, lost.count) == ("/scan", 7)
    assert "none for 0.80 s, where one each 0.100 s is usual" in lost.text


def scan_bytes(stamp: float) -> bytes:
    """The beginning of a LaserScan."""
    return header_bytes(stamp) + bytes(100)


def test_a_topic_without_messages_is_silent_once() -> None:
    patient = FAST.model_copy(update={"silence": 0.1})
    given = receive(
        advertise(channel(1, "/trigger"), channel(2, "/scan", SCAN)), topics=("/trigger", "/scan"),
        enough=count("missing", 2), settings=patient,
    )  # fmt: skip
    assert sorted(one.text for one in only(given, "missing")) == [
        "/scan: no message for 0 s", "/trigger: no message for 0 s",
    ]  # fmt: skip


def test_a_server_of_another_protocol_is_named() -> None:
    async def talk(connection: ServerConnection) -> None:
        await connection.wait_closed()

    async def run() -> list[LiveMessage | Notice]:
        async with foxglove_server(talk, select_subprotocol=lambda *_: None) as address:
            return await until(FoxgloveSource(address, FAST), ["/trigger"], count("disconnected", 1))

    (notice,) = only(asyncio.run(run()), "disconnected")
    assert "it speaks neither foxglove.sdk.v1 nor foxglove.websocket.v1" in notice.text


def test_a_server_that_is_not_there_is_named_once_for_many_attempts() -> None:
    async def run() -> list[LiveMessage | Notice]:
        server = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        server.close()
        given: list[LiveMessage | Notice] = []
        try:
            async with asyncio.timeout(0.5):
                async for one in FoxgloveSource(f"ws://127.0.0.1:{port}", FAST).stream(["/trigger"]):
                    given += [one] if one else []
        except TimeoutError:
            pass
        return given

    (notice,) = notices(asyncio.run(run()))
    assert notice.kind == "disconnected"
    assert "trying again" in notice.text


@pytest.mark.parametrize("address", ["ws://", "ws://127.0.0.1:99999", "ws://a robot:8765", "ws:robot"])
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(InputError, match=r"is no address .*give ws://HOST:PORT"):
        open_source(address, Settings())


def test_ros1_stamps_are_read_too() -> None:
    text, _ = ROS1.generate_msgdef(SCAN)
    described = channel(
        1, "/scan", "sensor_msgs/LaserScan", encoding="ros1", schemaEncoding="ros1msg", schema=text
    )
    stamps = [100 + 0.1 * k for k in range(30) if k != 26 and k != 27 and k != 25]
    frames = [
        data_frame(1, 5, struct.pack("<IIII", k, int(stamp), round(stamp % 1 * 1e9), 0) + bytes(80))
        for k, stamp in enumerate(stamps)
    ]
    given = receive(
        advertise(described), *frames, topics=("/scan",),
        enough=lambda given: len(messages(given)) == 27 and only(given, "lost"),
    )  # fmt: skip
    assert [one.count for one in only(given, "lost")] == [3]

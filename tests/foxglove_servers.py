"""A server of the older Foxglove protocol, whose frames a test chooses, and messages to send."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

from rosbags.typesys import Stores, get_typestore
from websockets.asyncio.server import ServerConnection, serve
from websockets.typing import Subprotocol

from calgraph.live.source import LiveMessage, Notice, Source

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
SCAN = "sensor_msgs/msg/LaserScan"
HEADER = "std_msgs/msg/Header"


def header_bytes(stamp: float) -> bytes:
    """A std_msgs/Header of ROS 2."""
    sec, nanosec = divmod(round(stamp * 1e9), 10**9)
    time = ROS2.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    return bytes(ROS2.serialize_cdr(ROS2.types[HEADER](stamp=time, frame_id="laser"), HEADER))


def channel(number: int, topic: str, type_name: str = HEADER, **fields: Any) -> dict[str, Any]:
    """A channel as servers advertise it."""
    described = {
        "id": number, "topic": topic, "encoding": "cdr", "schemaName": type_name, "schemaEncoding": "ros2msg",
        "schema": ROS2.generate_msgdef(type_name, ros_version=2)[0] if type_name in ROS2.fielddefs else "",
    }  # fmt: skip
    return {key: value for key, value in {**described, **fields}.items() if value is not None}


def advertise(*channels: dict[str, Any]) -> str:
    return json.dumps({"op": "advertise", "channels": channels})


def data_frame(subscription: int, arrival: int, content: bytes) -> bytes:
    return struct.pack("<BIQ", 1, subscription, arrival) + content


async def subscriptions(connection: ServerConnection) -> dict[int, int]:
    """The numbers of subscriptions, by channel, of the next request."""
    request = json.loads(await connection.recv())
    assert request["op"] == "subscribe"
    return {one["channelId"]: one["id"] for one in request["subscriptions"]}


@asynccontextmanager
async def foxglove_server(
    talk: Callable[[ServerConnection], Awaitable[None]], subprotocol: str = "foxglove.websocket.v1", **options: Any
) -> AsyncIterator[str]:
    """Serves connections with ``talk``; its address."""

    async def handle(connection: ServerConnection) -> None:
        await connection.send(json.dumps({"op": "serverInfo", "name": "test", "capabilities": []}))
        await talk(connection)

    async with serve(handle, "127.0.0.1", 0, subprotocols=[Subprotocol(subprotocol)], **options) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        yield f"ws://127.0.0.1:{port}"


async def until(
    source: Source, topics: list[str], enough: Callable[[list[LiveMessage | Notice]], bool]
) -> list[LiveMessage | Notice]:
    """What a source gives until a condition on it holds."""
    given: list[LiveMessage | Notice] = []
    stream = source.stream(topics)
    async with asyncio.timeout(60):
        async for one in stream:
            if one is not None:
                given.append(one)
            if enough(given):
                break
    await stream.aclose()  # type: ignore[attr-defined]  # an async generator
    return given

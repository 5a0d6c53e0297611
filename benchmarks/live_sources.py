"""Throughput of live sources: megabytes per second, messages lost, and processor time of the receiver.

    python benchmarks/live_sources.py [--seconds 4] [--load 1]

Another process publishes images of 0.6 and 0.1 MB, 30 and 100 a second times the load: 28 MB/s. They are received
and counted, not recorded. The replay reads a recording of as many messages as fast as it can.
"""

import asyncio
import multiprocessing
import os
import struct
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import foxglove
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import Settings
from calgraph.live.dds import make_dds_type
from calgraph.live.open_source import open_source
from calgraph.live.source import LiveMessage
from worlds import make_parser

TOPICS = {"/image": (600_000, 30), "/preview": (100_000, 100)}
"""Bytes and messages per second at load 1."""
TYPE = "sensor_msgs/msg/CompressedImage"
STORE = get_typestore(Stores.ROS2_HUMBLE)
DOMAIN = 77
WARM_UP = 2.0
LOOPBACK = (
    '<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface name="lo" '
    'multicast="false"/></Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer '
    'address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)


def stamp_of(number: int, rate: float) -> tuple[int, int]:
    """Seconds and nanoseconds of the stamp of a message."""
    return divmod(10**9 + round(number / rate * 1e9), 10**9)


def content(number: int, rate: float, size: int) -> bytes:
    """A CompressedImage, as CDR."""
    return struct.pack("<IiIII", 0x00000100, *stamp_of(number, rate), 1, 0) + bytes(size)


def publish(send: dict[str, Callable[[int], object]], seconds: float, load: float) -> int:
    """Publishes at a constant rate; the number of messages."""
    sent = dict.fromkeys(TOPICS, 0)
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < seconds:
        for topic, (_, rate) in TOPICS.items():
            while sent[topic] < elapsed * rate * load:
                send[topic](sent[topic])
                sent[topic] += 1
        time.sleep(0.001)
    return sum(sent.values())


def _log(channel: foxglove.Channel, rate: float, size: int, number: int) -> None:
    channel.log(content(number, rate, size))


def _write(writer: Any, made: Any, rate: float, data: bytes, number: int) -> None:
    header, stamp = make_dds_type("std_msgs/msg/Header"), make_dds_type("builtin_interfaces/msg/Time")
    writer.write(made(header(stamp(*stamp_of(number, rate)), ""), "", data))


def serve_foxglove(queue: Any, seconds: float, load: float) -> None:
    """A Foxglove server with the messages."""
    context = foxglove.Context()
    text, _ = STORE.generate_msgdef(TYPE, ros_version=2)
    schema = foxglove.Schema(name=TYPE, encoding="ros2msg", data=text.encode())
    send: dict[str, Callable[[int], object]] = {}
    for topic, (size, rate) in TOPICS.items():
        channel = foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=context)
        send[topic] = partial(_log, channel, rate * load, size)
    server = foxglove.start_server(host="127.0.0.1", port=0, context=context)
    queue.put(f"ws://127.0.0.1:{server.port}")
    time.sleep(WARM_UP)
    queue.put(publish(send, seconds, load))
    time.sleep(1)
    server.stop()


def serve_dds(queue: Any, seconds: float, load: float) -> None:
    """Publishers of ROS 2 with the messages."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    participant = DomainParticipant(DOMAIN)
    made = make_dds_type(TYPE)
    quality = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    send: dict[str, Callable[[int], object]] = {}
    for topic, (size, rate) in TOPICS.items():
        writer = DataWriter(participant, Topic(participant, f"rt{topic}", made), qos=quality)
        send[topic] = partial(_write, writer, made, rate * load, bytes(size))
    queue.put(f"ros2://{DOMAIN}")
    time.sleep(WARM_UP)
    queue.put(publish(send, seconds, load))
    time.sleep(1)


async def receive(address: str, seconds: float) -> tuple[int, int, float, int]:
    """Messages, bytes, seconds from the first to the last, and messages that notices state as lost."""
    count = size = lost = 0
    begin = end = 0.0
    stream = open_source(address, Settings(), speed=0).stream(list(TOPICS))
    try:
        async with asyncio.timeout(seconds):
            async for one in stream:
                if isinstance(one, LiveMessage):
                    begin, end = begin or time.monotonic(), time.monotonic()
                    count, size = count + 1, size + len(one.data)
                elif one.kind == "lost":
                    lost += one.count
                elif one.kind == "ended":
                    break
    except TimeoutError:
        pass
    return count, size, max(end - begin, 1e-9), lost


def report(name: str, address: str, seconds: float, sent: Callable[[], int]) -> None:
    """Receives, and prints a row."""
    began = time.process_time()
    count, size, duration, lost = asyncio.run(receive(address, seconds))
    processor = time.process_time() - began
    missing = sent() - count
    print(
        f"{name:9} {size / 1e6 / duration:8.1f} MB/s  {count:6d} messages  {missing:4d} missing  "
        f"{lost:4d} noticed  {processor:5.2f} s CPU  {1e9 * processor / max(size, 1):5.2f} s CPU/GB"
    )


def main() -> None:
    """Measures all sources."""
    parser = make_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--load", type=float, default=1.0)
    given = parser.parse_args()
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    for name, serve in (("foxglove", serve_foxglove), ("ros2", serve_dds)):
        queue: Any = multiprocessing.get_context("spawn").Queue()
        process = multiprocessing.get_context("spawn").Process(
            target=serve, args=(queue, given.seconds, given.load)
        )
        process.start()
        report(name, queue.get(), given.seconds + WARM_UP + 1, queue.get)
        process.join()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "bag"
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {topic: writer.add_connection(topic, TYPE, typestore=STORE) for topic in TOPICS}
            numbers = {topic: iter(range(10**9)) for topic in TOPICS}
            total = 0
            for k in range(int(given.seconds * given.load * 100)):
                for topic, (size, rate) in TOPICS.items():
                    if k * rate // 100 < (k + 1) * rate // 100:
                        total += 1
                        writer.write(connections[topic], k * 10**7, content(next(numbers[topic]), rate, size))
        report("replay", str(folder), 60, lambda: total)


if __name__ == "__main__":
    main()

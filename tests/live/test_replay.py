"""Recordings as live sources: their messages as stored, at the pace at which they arrived."""

import asyncio
import re
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calgraph.config.settings import Settings
from calgraph.errors import InputError, RecordingError
from calgraph.live.open_source import open_source
from calgraph.live.replay import ReplaySource
from calgraph.live.source import LiveMessage
from calgraph.recording import RecordingWriter, open_recording
from calgraph.sensors import LaserScan, MessageDigest, RecordedMessage, Trigger
from collected_sources import collect, messages, notices

EPOCH = 1_700_000_000


def scan(stamp: float, topic_range: float = 2.0) -> LaserScan:
    angles = np.linspace(-1, 1, 5)
    return LaserScan(stamp, "laser", angles, np.full(5, topic_range), 0.0)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Scans at 0, 0.1, ..., 0.9 s and triggers at 0.05, 0.55 s; arrivals are 2 ms later."""
    path = tmp_path / "a bag"
    with RecordingWriter(path) as writer:
        times = [("/scan", k / 10) for k in range(10)] + [("/trigger", 0.05), ("/trigger", 0.55)]
        for topic, at in sorted(times, key=lambda one: one[1]):
            stamp = EPOCH + at
            message = scan(stamp) if topic == "/scan" else Trigger(stamp)
            writer.write(topic, message, stamp + 0.002)
    return path


def test_messages_are_those_of_the_bag_byte_for_byte(bag: Path) -> None:
    given = messages(collect(ReplaySource(bag, speed=0), ["/scan", "/trigger"]))
    assert [one.channel.topic for one in given].count("/trigger") == 2
    assert [one.arrival for one in given] == sorted(one.arrival for one in given)
    first = given[0]
    assert first.channel.type == "sensor_msgs/msg/LaserScan"
    assert (first.channel.encoding, first.channel.schema_format) == ("cdr", "ros2msg")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(first.channel.schema, first.channel.type))
    content: Any = store.deserialize_cdr(first.data, first.channel.type)
    assert content.ranges.tolist() == [2.0] * 5


def test_the_end_is_noticed(bag: Path) -> None:
    kinds = [one.kind for one in notices(collect(ReplaySource(bag, speed=0), ["/scan"]))]
    assert kinds == ["connected", "ended"]


def test_other_topics_are_left_out(bag: Path) -> None:
    given = messages(collect(ReplaySource(bag, speed=0), ["/trigger"]))
    assert {one.channel.topic for one in given} == {"/trigger"}


def test_a_missing_topic_is_noticed_with_its_likely_name(bag: Path) -> None:
    given = collect(ReplaySource(bag, speed=0), ["/scans", "/trigger"])
    (missing,) = [one for one in notices(given) if one.kind == "missing"]
    assert missing.topic == "/scans"
    assert "did you mean '/scan'?" in missing.text
    assert len(messages(given)) == 2


def test_a_resumed_replay_starts_after_the_last_message(bag: Path) -> None:
    everything = messages(collect(ReplaySource(bag, speed=0), ["/scan", "/trigger"]))
    last = everything[6].arrival
    rest = messages(collect(ReplaySource(bag, speed=0, start_after=last), ["/scan", "/trigger"]))
    assert [one.arrival for one in rest] == [one.arrival for one in everything[7:]]


def test_of_messages_that_arrive_at_once_the_unrecorded_ones_follow(tmp_path: Path) -> None:
    """A camera's image and its CameraInfo arrive at once; a session may be killed between them."""
    with RecordingWriter(tmp_path / "bag") as writer:
        for topic, second in (("/a", 1), ("/b", 1), ("/a", 2), ("/b", 2)):
            writer.write(topic, Trigger(EPOCH + second), EPOCH + second)

    def replay(but: list[str]) -> list[tuple[str, int]]:
        source = ReplaySource(tmp_path / "bag", speed=0, start_after=(EPOCH + 1) * 10**9, but=but)
        given = messages(collect(source, ["/a", "/b"]))
        return [(one.channel.topic, round(one.arrival / 1e9) - EPOCH) for one in given]

    assert replay(["/a"]) == [("/b", 1), ("/a", 2), ("/b", 2)]
    assert replay(["/a", "/b"]) == [("/a", 2), ("/b", 2)]


def test_no_message_is_early_and_all_come_within_the_time_that_the_speed_states(bag: Path) -> None:
    async def run() -> list[tuple[float, int]]:
        source = ReplaySource(bag, speed=5)
        stream = source.stream(["/scan"])
        return [(time.monotonic(), one.arrival) async for one in stream if isinstance(one, LiveMessage)]

    received = asyncio.run(run())
    began, first = received[0]
    early = [(arrival - first) / 1e9 / 5 - (at - began) for at, arrival in received]
    assert max(early) < 0.002
    assert received[-1][0] - began >= 0.178


def test_an_hour_is_replayed_fast(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "long") as writer:
        writer.write("/scan", scan(EPOCH), EPOCH)
        writer.write("/scan", scan(EPOCH + 3600), EPOCH + 3600)
    began = time.monotonic()
    assert len(messages(collect(ReplaySource(tmp_path / "long", speed=36000), ["/scan"]))) == 2
    assert time.monotonic() - began < 30


def test_other_tasks_run_while_nothing_is_waited_for(bag: Path) -> None:
    async def run() -> int:
        turns = 0

        async def count() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(count())
        async for _ in ReplaySource(bag, speed=0).stream(["/scan"]):
            pass
        task.cancel()
        return turns

    assert asyncio.run(run()) >= 10


def test_messages_of_ros1_keep_their_encoding(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    header = store.types["std_msgs/msg/Header"](
        seq=7, stamp=store.types["builtin_interfaces/msg/Time"](sec=EPOCH, nanosec=5), frame_id="laser"
    )
    content = store.serialize_ros1(header, "std_msgs/msg/Header")
    with Writer1(tmp_path / "old.bag") as writer:
        connection = writer.add_connection("/trigger", "std_msgs/msg/Header", typestore=store)
        writer.write(connection, EPOCH * 10**9, content)
    (given,) = messages(collect(ReplaySource(tmp_path / "old.bag", speed=0), ["/trigger"]))
    assert (given.channel.encoding, given.channel.schema_format) == ("ros1", "ros1msg")
    assert given.channel.type == "std_msgs/msg/Header"
    assert given.data == bytes(content)
    assert "uint32 seq" in given.channel.schema


def test_a_recording_without_definitions_has_those_of_ros(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=EPOCH, nanosec=0), frame_id="laser"
    )
    writer = Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        connection = writer.add_connection("/trigger", "std_msgs/msg/Header", typestore=store)
        writer.write(connection, EPOCH * 10**9, store.serialize_cdr(header, "std_msgs/msg/Header"))
    strip_definitions(tmp_path / "bag" / "bag.db3")
    (given,) = messages(collect(ReplaySource(tmp_path / "bag", speed=0), ["/trigger"]))
    assert given.channel.schema_format == "ros2msg"
    assert "MSG: builtin_interfaces/Time" in given.channel.schema


def strip_definitions(database: Path) -> None:
    """Makes a database as ROS 2 Humble writes it."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("DELETE FROM message_definitions")


def test_images_of_a_folder_are_serialised_as_ros_does(tmp_path: Path) -> None:
    (tmp_path / "camera").mkdir()
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    for second in (1, 2):
        cv2.imwrite(str(tmp_path / "camera" / f"{EPOCH + second}.500000000.png"), pixels)
    given = messages(collect(ReplaySource(tmp_path, speed=0), ["camera"]))
    assert [one.arrival for one in given] == [round((EPOCH + k + 0.5) * 1e9) for k in (1, 2)]
    image: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(given[0].data, given[0].channel.type)
    assert image.header.stamp.sec == EPOCH + 1
    np.testing.assert_array_equal(image.data.reshape(4, 4, 3), pixels)


def test_a_resumed_replay_of_a_folder_starts_after_the_last_message(tmp_path: Path) -> None:
    (tmp_path / "camera").mkdir()
    for second in (1, 2, 3):
        cv2.imwrite(str(tmp_path / "camera" / f"{EPOCH + second}.png"), np.zeros((4, 4, 3), np.uint8))
    source = ReplaySource(tmp_path, speed=0, start_after=(EPOCH + 2) * 10**9)
    assert [one.arrival for one in messages(collect(source, ["camera"]))] == [(EPOCH + 3) * 10**9]


def test_numbered_poses_have_no_time_to_replay(tmp_path: Path) -> None:
    (tmp_path / "camera").mkdir()
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / "camera" / f"{number:03d}.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="numbered by pose"):
        collect(ReplaySource(tmp_path, speed=0), ["camera"])


def test_messages_that_are_not_cdr_are_noticed_once(bag: Path) -> None:
    (storage,) = bag.glob("*.mcap")
    content = storage.read_bytes().replace(b"\x03\x00\x00\x00cdr", b"\x03\x00\x00\x00xyz")
    storage.write_bytes(content)
    given = collect(ReplaySource(bag, speed=0), ["/trigger"])
    assert messages(given) == []
    (missing,) = [one for one in notices(given) if one.kind == "missing"]
    assert missing.topic == "/trigger"
    assert "sessions read CDR, and not xyz: use calgraph calibrate" in missing.text


def test_a_damaged_recording_is_an_error(bag: Path) -> None:
    (storage,) = bag.glob("*.mcap")
    storage.write_bytes(storage.read_bytes()[:40])
    with pytest.raises(RecordingError, match=re.escape(storage.name)):
        collect(ReplaySource(bag, speed=0), ["/scan"])


@pytest.mark.parametrize("speed", [-1.0, float("inf"), float("nan")])
def test_an_impossible_speed_is_refused(bag: Path, speed: float) -> None:
    with pytest.raises(InputError, match="give 1 for real time"):
        ReplaySource(bag, speed=speed)


def describe(record: RecordedMessage) -> tuple[str, float, float, MessageDigest]:
    assert record.digest is not None
    return record.topic, record.stamp, record.arrival, record.digest()


def test_replayed_messages_written_again_are_the_same_recording(bag: Path, tmp_path: Path) -> None:
    with open_recording(bag) as recording:
        originals = [describe(one) for one in recording.records()]
    given = messages(collect(open_source(str(bag), Settings(), speed=0), ["/scan", "/trigger"]))
    copy = Writer(tmp_path / "copy", version=9, storage_plugin=StoragePlugin.MCAP)
    with copy:
        connections: dict[str, Any] = {}
        for one in given:
            channel = one.channel
            if channel.topic not in connections:
                store = get_typestore(Stores.EMPTY)
                store.register(get_types_from_msg(channel.schema, channel.type))
                connections[channel.topic] = copy.add_connection(channel.topic, channel.type, typestore=store)
            copy.write(connections[channel.topic], one.arrival, one.data)
    with open_recording(tmp_path / "copy") as recording:
        again = [describe(one) for one in recording.records()]
    assert again == originals

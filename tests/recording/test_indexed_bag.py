"""ROS 1 bags: chunks that overlap in time, and indexes that name parts of the bag several times."""

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.recording.chunk_limits import LimitedBagReader

COUNT = 30
STORE = get_typestore(Stores.ROS1_NOETIC)
TEXT = STORE.types["std_msgs/msg/String"]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two topics, of which one was written after the other; their messages alternate in time."""
    path = tmp_path / "by topic.bag"
    writer = Writer(path)
    writer.chunk_threshold = 1000
    writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer:
        for topic in (0, 1):
            connection = writer.add_connection(f"/{topic}", "std_msgs/msg/String", typestore=STORE)
            for number in range(COUNT):
                message = STORE.serialize_ros1(
                    TEXT(data=f"{2 * number + topic}" + " " * 100), "std_msgs/msg/String"
                )
                writer.write(connection, 10**9 + 2 * number + topic, message)
    return path


@pytest.fixture
def open_bag(bag: Path) -> Iterator[Callable[..., LimitedBagReader]]:
    with ExitStack() as stack:

        def open_with(**limits: int) -> LimitedBagReader:
            return stack.enter_context(LimitedBagReader(bag, LimitSettings(**limits)))

        yield open_with


def read_numbers(reader: LimitedBagReader) -> list[int]:
    messages: list[Any] = [STORE.deserialize_ros1(raw, "std_msgs/msg/String") for _, _, raw in reader.messages()]
    return [int(message.data) for message in messages]


def count_unpacked(reader: LimitedBagReader) -> list[int]:
    """The positions of the chunks that are unpacked from now on."""
    unpacked: list[int] = []

    def wrap(position: int, decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        def count(data: bytes) -> bytes:
            unpacked.append(position)
            return decompress(data)

        return count

    for position, chunk in reader.chunks.items():
        reader.chunks[position] = chunk._replace(decompressor=wrap(position, chunk.decompressor))
    return unpacked


def test_chunks_that_overlap_in_time_are_unpacked_once(open_bag: Callable[..., LimitedBagReader]) -> None:
    reader = open_bag()
    unpacked = count_unpacked(reader)
    assert read_numbers(reader) == list(range(2 * COUNT))
    assert len(unpacked) == len(set(unpacked)) == len(reader.chunks) > 4


def test_chunks_beyond_the_limit_of_memory_are_unpacked_again(open_bag: Callable[..., LimitedBagReader]) -> None:
    reader = open_bag(max_overlapping_bytes=1)
    unpacked = count_unpacked(reader)
    assert read_numbers(reader) == list(range(2 * COUNT))
    assert len(unpacked) == 2 * COUNT


@pytest.mark.parametrize(("start", "stop"), [(10**9 + 7, 10**9 + 11), (None, 10**9 + 3), (10**9 + 57, None)])
def test_messages_of_a_window(
    open_bag: Callable[..., LimitedBagReader], start: int | None, stop: int | None
) -> None:
    reader = open_bag()
    times = [time for _, time, _ in reader.messages(reader.connections[:1], start, stop)]
    assert times == [
        time
        for time in range(10**9, 10**9 + 2 * COUNT, 2)
        if (start is None or time >= start) and (stop is None or time < stop)
    ]


def test_an_index_that_names_one_message_many_times_is_refused(open_bag: Callable[..., LimitedBagReader]) -> None:
    reader = open_bag()
    reader.indexes[0] = [entry for entry in reader.indexes[0] for _ in range(50)]
    with pytest.raises(ValueError, match="names one part of a chunk several times"):
        read_numbers(reader)


def test_an_index_with_another_time_than_the_message_is_refused(open_bag: Callable[..., LimitedBagReader]) -> None:
    reader = open_bag()
    reader.indexes[0] = [entry._replace(time=entry.time + 1) for entry in reader.indexes[0]]
    with pytest.raises(ValueError, match="another time than a message"):
        read_numbers(reader)


def test_a_chunk_that_is_named_many_times_is_refused(tmp_path: Path) -> None:
    """Each time its index is in memory again: 20 copies of 90 bytes would take 20 times the index of 12 kB."""
    bag = tmp_path / "one chunk.bag"
    with Writer(bag) as writer:
        connection = writer.add_connection("/empty", "std_msgs/msg/Empty", typestore=STORE)
        for number in range(1000):
            writer.write(connection, 10**9 + number, b"")
    data = bag.read_bytes()
    stated = b"chunk_count=" + struct.pack("<I", 1)
    assert data.count(stated) == 1
    copies = data[_find_last_record(data) :] * 20
    bag.write_bytes(data.replace(stated, b"chunk_count=" + struct.pack("<I", 21)) + copies)
    with pytest.raises(RecordingError, match="names one part of the file several times"):
        open_recording(bag)


def _find_last_record(data: bytes) -> int:
    """The position of the last record: its header and data each have their length before them."""
    position = len(b"#ROSBAG V2.0\n")
    while True:
        begin = position
        for _ in ("header", "data"):
            (size,) = struct.unpack_from("<I", data, position)
            position += 4 + size
        if position >= len(data):
            return begin


def test_the_same_recording_is_read_from_other_forms(bag: Path) -> None:
    with open_recording(bag) as recording:
        stamps = np.array([record.arrival for record in recording.records()])
    np.testing.assert_allclose(np.diff(stamps), 1e-9, atol=1e-7)
    assert len(stamps) == 2 * COUNT

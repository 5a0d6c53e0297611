"""Chunks of bags are unpacked within limits, and YAML in bags is parsed within limits."""

import bz2
import struct
import tracemalloc
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import apsw
import lz4.frame
import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin, metadata, storage_mcap, storage_sqlite3
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.recording.limited_storage import unpack_chunk
from mcap_records import pack_records, read_records

MakeBag = Callable[..., Path]
TIGHT = LimitSettings(max_unpacked_bytes=100_000)
TOO_LARGE = "unpacks to more than the limit of 0 MB: it is damaged, or needs limits.max_unpacked_bytes"
MAGIC = b"\x89MCAP0\r\n"
CHUNK, CHUNK_INDEX, DATA_END, FOOTER, CHANNEL = 6, 8, 15, 2, 4


@pytest.fixture
def bag(make_bag: MakeBag, ros: SimpleNamespace) -> Path:
    """An MCAP with a compressed chunk of 300 kB."""
    pixels = np.zeros((300, 1000), np.uint8)
    path = make_bag(("/image", ros.image(pixels, "mono8"), 20.0), compression=CompressionMode.STORAGE)
    return next(path.glob("*.mcap"))


def read_all(path: Path, limits: LimitSettings) -> int:
    with open_recording(path, limits) as recording:
        return len([record.decode() for record in recording.records()])


def rewrite(path: Path, change: Callable[[int, bytes], bytes], *, summary: bool) -> None:
    """Writes an MCAP again with changed records; offsets in the summary hold if the data keep their lengths."""
    records = [(op, change(op, content)) for op, content in read_records(path.read_bytes()[8:-8])]
    end = next(i for i, (op, _) in enumerate(records) if op == DATA_END)
    body = MAGIC + pack_records(records[: end + 1])
    rest = [record for record in records[end + 1 :] if record[0] != FOOTER] if summary else []
    footer = struct.pack("<QQI", len(body) if summary else 0, 0, 0)
    path.write_bytes(body + pack_records([*rest, (FOOTER, footer)]) + MAGIC)


def test_rosbags_itself_is_as_it_was_for_others() -> None:
    assert all(vars(module)["parse_qos"] is metadata.parse_qos for module in (storage_mcap, storage_sqlite3))
    pixels = bytes(300_000)
    assert storage_mcap.decompress(zstd.compress(pixels), "zstd", len(pixels), 0) == pixels
    with pytest.raises(UnicodeDecodeError):
        storage_mcap.read_string(BytesIO(b"\x01\0\0\0\xff"))


@pytest.mark.parametrize("summary", [True, False])
def test_a_chunk_larger_than_the_limit_is_refused(bag: Path, summary: bool) -> None:
    rewrite(bag, lambda _, content: content, summary=summary)
    assert bag.stat().st_size < 20_000
    assert read_all(bag, LimitSettings()) == 1
    with pytest.raises(RecordingError, match=rf"bag\.mcap: {TOO_LARGE}"):
        read_all(bag, TIGHT)


@pytest.mark.parametrize("summary", [True, False])
def test_a_chunk_is_unpacked_to_its_stated_size_only(bag: Path, summary: bool) -> None:
    def understate(op: int, content: bytes) -> bytes:
        if op == CHUNK:
            return content[:16] + struct.pack("<QI", 1000, 0) + content[28:]
        if op == CHUNK_INDEX:
            return content[:-8] + struct.pack("<Q", 1000)
        return content

    rewrite(bag, understate, summary=summary)
    tracemalloc.start()
    with pytest.raises(RecordingError, match="Chunk size mismatch: expected 1000 bytes, got 1001"):
        read_all(bag, LimitSettings())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6


def test_chunks_that_overlap_in_time_are_limited_together(bag: Path) -> None:
    records = read_records(bag.read_bytes()[8:-8])
    index = next(record for record in records if record[0] == CHUNK_INDEX)
    at = bag.read_bytes().rindex(pack_records([index]))
    data = bag.read_bytes()
    bag.write_bytes(data[:at] + pack_records([index] * 4) + data[at:])
    with pytest.raises(RecordingError, match=r"chunks that overlap in time unpack to more than the limit of 1 MB"):
        read_all(bag, LimitSettings(max_overlapping_bytes=10**6))


@pytest.mark.parametrize("compression", [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_a_chunk_of_a_ros_1_bag_larger_than_the_limit_is_refused(tmp_path: Path, compression: Any) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    path = tmp_path / "old.bag"
    writer = Writer1(path)
    writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=store)
        message = store.types["std_msgs/msg/String"]("a" * 300_000)
        writer.write(connection, 10**9, store.serialize_ros1(message, "std_msgs/msg/String"))
    assert read_all(path, LimitSettings()) == 1
    with pytest.raises(RecordingError, match=rf"old\.bag: {TOO_LARGE}"):
        read_all(path, TIGHT)


@pytest.mark.parametrize(
    ("compress", "decompressor"),
    [
        (zstd.compress, zstd.ZstdDecompressor),
        (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        (bz2.compress, bz2.BZ2Decompressor),
    ],
)
def test_a_chunk_of_several_frames_is_unpacked(compress: Any, decompressor: Any) -> None:
    parts = [b"a" * 10, b"b" * 1000]
    packed = b"".join(map(compress, parts))
    assert unpack_chunk(packed, 1010, decompressor) == b"".join(parts)
    assert unpack_chunk(packed, 1009, decompressor) == b"".join(parts)
    assert unpack_chunk(packed, 500, decompressor) == b"".join(parts)[:501]
    assert unpack_chunk(b"", 10, decompressor) == b""
    with pytest.raises(EOFError, match="cut short"):
        unpack_chunk(packed[:-6], 2000, decompressor)


_LEVELS = [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}" for i in range(1, 9)]
QOS = "\n".join(["a0: &a0 {k: 1}", *_LEVELS])


@pytest.mark.parametrize("summary", [True, False])
def test_qos_profiles_of_an_mcap_are_limited(bag: Path, summary: bool) -> None:
    def add_qos(op: int, content: bytes) -> bytes:
        if op != CHANNEL:
            return content
        metadata = b"".join(struct.pack("<I", len(t)) + t for t in (b"offered_qos_profiles", QOS.encode()))
        position = 4
        for _ in range(2):
            position += 4 + struct.unpack_from("<I", content, position)[0]
        return content[:position] + struct.pack("<I", len(metadata)) + metadata

    data = bag.read_bytes()
    channel = next(record for record in read_records(data[8:-8]) if record[0] == CHANNEL)
    rewrite(bag, add_qos, summary=summary)
    if not summary:  # the channel is in the chunk otherwise
        records = read_records(bag.read_bytes()[8:-8])
        records.insert(1, (CHANNEL, add_qos(*channel)))
        bag.write_bytes(MAGIC + pack_records(records) + MAGIC)
    with pytest.raises(RecordingError, match=r"offered_qos_profiles, line .*: has more than 5000 values"):
        open_recording(bag)


def test_qos_profiles_of_a_database_are_limited(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    path = make_bag(("/scan", ros.scan(), 20.0), storage=StoragePlugin.SQLITE3)
    [file] = path.glob("*.db3")
    database = apsw.Connection(str(file))
    database.execute("UPDATE topics SET offered_qos_profiles = ?", (QOS,))
    database.close()
    with pytest.raises(RecordingError, match=r"offered_qos_profiles, line .*: has more than 5000 values"):
        open_recording(file)


def test_computed_messages_of_a_database_are_limited(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    path = make_bag(("/scan", ros.scan(), 20.0), storage=StoragePlugin.SQLITE3)
    [file] = path.glob("*.db3")
    database = apsw.Connection(str(file))
    database.execute("DROP TABLE messages")
    columns = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(300000))"
    database.execute(f"CREATE TABLE messages({columns})")
    database.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 20000000000)")
    database.close()
    with pytest.raises(RecordingError, match="string or blob too big"):
        read_all(file, TIGHT)

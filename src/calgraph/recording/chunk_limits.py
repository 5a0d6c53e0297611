"""Readers of bags that check chunks before any is unpacked; of MCAPs that are not of ROS 2 or have no end, too.

ROS 1 bags take time that grows with their size only. rosbags unpacks a chunk whenever the next message is in
another one: at every message where the topics were written one after the other. And it follows an index that names
one part of a chunk any number of times.
"""

import heapq
import os
from collections.abc import Collection, Generator, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from struct import unpack
from typing import Any

import apsw
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import reader as bags1
from rosbags.rosbag1.reader import Header, IndexData, RecordType, read_bytes, read_uint32
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError
from rosbags.typesys.msg import normalize_msgtype

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import check_unpacked_size
from calgraph.recording.limited_storage import DECOMPRESSORS, storage_mcap, storage_sqlite3, unpack_chunk
from calgraph.recording.message_types import serialization_of
from calgraph.recording.unfinished_mcap import complete_mcap, lacks_end, replace_start

# Records of a chunk follow each other, so that all of them together are as long as the chunk; more is tolerated,
# as writers may index a message at the connections before it.
_MAX_REPETITIONS = 4


@dataclass
class _OpenChunk:
    """An unpacked chunk."""

    stream: BytesIO
    size: int
    end: int
    """Time of its last message, ns."""
    unread: int
    """Bytes that may still be read from it."""


class LimitedBagReader(Reader):
    """A ROS 1 bag.

    Args:
        path: of the file.
        limits: maximum size of the chunks that are in memory together.
    """

    def __init__(self, path: Path, limits: LimitSettings) -> None:
        super().__init__(path)
        self._limits = limits
        self._index_bytes = 0

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Reads a part of the index, of which damaged records name one any number of times.

        Raises:
            ValueError: all parts together are longer than the file.
        """
        assert self.bio
        begin = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._index_bytes += self.bio.tell() - begin
        if self._index_bytes > self.path.stat().st_size:
            raise ValueError("its index names one part of the file several times")

    def messages(
        self, connections: Collection[Connection] = (), start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Connection, arrival time (ns) and bytes of the messages of some connections, or of all.

        Args:
            connections: without them all.
            start: messages before it are left out, ns.
            stop: this and later messages are left out, ns.

        Raises:
            ValueError: the index names one message several times.
            Exception: anything that rosbags raises for damaged bytes.
        """
        by_number = {connection.id: connection for connection in self.connections}
        chunks: dict[int, _OpenChunk] = {}
        ends = {info.pos: info.end_time for info in self.chunk_infos}
        for entry in heapq.merge(*(self.indexes[one.id] for one in connections or self.connections)):
            if start is not None and entry.time < start:
                continue
            if stop is not None and entry.time >= stop:
                return
            chunk = chunks.get(entry.chunk_pos) or self._open_chunk(entry, chunks, ends)
            number, time, data = _read_message(chunk, entry.offset)
            if time != entry.time:
                raise ValueError("its index states another time than a message")
            yield by_number[number], entry.time, data

    def _open_chunk(self, entry: IndexData, chunks: dict[int, _OpenChunk], ends: Mapping[int, int]) -> _OpenChunk:
        """Unpacks a chunk, and closes those that have ended, or that are too many."""
        assert self.bio
        header = self.chunks[entry.chunk_pos]
        self.bio.seek(header.datapos)
        content = header.decompressor(read_bytes(self.bio, header.datasize))
        for position in [position for position, one in chunks.items() if one.end <= entry.time]:
            del chunks[position]
        while (
            chunks and sum(one.size for one in chunks.values()) + len(content) > self._limits.max_overlapping_bytes
        ):
            del chunks[next(iter(chunks))]
        opened = _OpenChunk(
            BytesIO(content), len(content), ends.get(entry.chunk_pos, 0), _MAX_REPETITIONS * len(content)
        )
        chunks[entry.chunk_pos] = opened
        return opened


def _read_message(chunk: _OpenChunk, offset: int) -> tuple[int, int, bytes]:
    """Number of the connection, time and bytes of the message at an offset, or after the connections there."""
    stream = chunk.stream
    stream.seek(offset)
    while (header := Header.read(stream)).get_uint8("op") == RecordType.CONNECTION:
        stream.seek(read_uint32(stream), os.SEEK_CUR)
        _take(chunk, stream.tell() - offset)
        offset = stream.tell()
    if header.get_uint8("op") != RecordType.MSGDATA:
        raise ValueError("its index names what is no message")
    data = read_bytes(stream, read_uint32(stream))
    _take(chunk, stream.tell() - offset)
    return header.get_uint32("conn"), header.get_time("time"), data


def _take(chunk: _OpenChunk, size: int) -> None:
    chunk.unread -= size
    if chunk.unread < 0:
        raise ValueError("its index names one part of a chunk several times")


# Records of an MCAP.
_CHUNK = 0x06
# Behind magic number and head of the first record: the profile, of which readers ignore the rest of the record.
_PROFILE_START, _ROS2_PROFILE = 8 + 9, b"\x04\x00\x00\x00ros2"
_SORTED_MESSAGES = (
    "SELECT id, topic_id, timestamp FROM messages WHERE timestamp >= ? AND timestamp < ? ORDER BY timestamp, id"
)
# Times are whole numbers of 64 bits.
_FIRST_TIME, _LAST_TIME = -(2**63), 2**63 - 1


class _McapReader(storage_mcap.McapReader):
    """An MCAP whose chunks are checked before any is unpacked, and which may have no end."""

    limits: LimitSettings
    is_finished = True

    def _open(self) -> None:
        """Reads the index of the file, or makes one where it has no end; names of types become those of ROS 2."""
        assert self.bio
        # Profiles only name conventions: the encoding of each topic decides whether it can be read.
        self.bio = replace_start(self.bio, _ROS2_PROFILE, _PROFILE_START)
        try:
            super()._open()
        except ReaderError:
            # Where its data begin is known if its header could be read.
            if not self.data_start or not lacks_end(self.bio):
                raise
            self.bio = complete_mcap(self.bio, self.limits)
            self.is_finished = False
            super()._open()
        self.connections = [
            one._replace(msgtype=normalize_msgtype(one.msgtype)) if serialization_of(one) == "ros1" else one
            for one in self.connections
        ]

    def meta_scan(self) -> None:
        """Reads the records of a file without a summary."""
        assert self.bio
        self.bio.seek(self.data_start)
        while self.bio.tell() < self.data_end and len(head := self.bio.read(9)) == 9:
            op, size = unpack("<BQ", head)
            after = self.bio.tell() + size
            if op == _CHUNK and len(times := self.bio.read(24)) == 24:
                check_unpacked_size(unpack("<16xQ", times)[0], self.limits)
            self.bio.seek(after)
        super().meta_scan()


class _SqliteReader(storage_sqlite3.Sqlite3Reader):
    """A database whose messages are sorted without their content, as SQLite does it in memory without an index."""

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Connection, arrival time (ns) and bytes of the messages of some connections, in order of time."""
        assert self.dbconn
        by_number = {connection.id: connection for connection in connections}
        span = (_FIRST_TIME if start is None else start, _LAST_TIME if stop is None else stop)
        for number, topic, time in self.dbconn.execute(_SORTED_MESSAGES, span):
            if topic in by_number:
                for (data,) in self.dbconn.execute("SELECT data FROM messages WHERE id = ?", (number,)):
                    yield by_number[topic], time, data


class _Reader2(Reader2):
    STORAGE_PLUGINS: Mapping[str, Any] = {**Reader2.STORAGE_PLUGINS, ".mcap": _McapReader, ".db3": _SqliteReader}


def open_reader(path: Path, limits: LimitSettings) -> Reader1 | Reader2:
    """Opens a storage file.

    Raises:
        ValueError: a chunk, or all that overlap in time, unpack to more than the limit; an MCAP has no end and no
            complete chunk.
        Exception: anything that rosbags raises for damaged bytes.
    """
    if path.suffix == ".bag":
        bag = LimitedBagReader(path, limits)
        bag.open()
        for position, chunk in bag.chunks.items():
            name = next(name for name, one in bags1.decompressors.items() if one is chunk.decompressor)
            if name in DECOMPRESSORS:
                bag.chunks[position] = chunk._replace(decompressor=partial(_unpack_bag_chunk, name, limits))
        return bag
    reader = _Reader2(path)
    storage = reader.storage
    if isinstance(storage, _McapReader):
        storage.limits = limits
    reader.open()
    try:
        if isinstance(storage, _McapReader):
            _check_chunks(storage.chunks, limits)
        elif isinstance(storage, storage_sqlite3.Sqlite3Reader) and storage.dbconn:
            # A column may be computed, and then have any size.
            storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, limits.max_unpacked_bytes)
    except BaseException:
        reader.close()
        raise
    return reader


def is_finished(reader: Reader1 | Reader2) -> bool:
    """Whether the end of a storage file is there: without it, a reader has the messages before."""
    storage = reader.storage if isinstance(reader, Reader2) else None
    return not isinstance(storage, _McapReader) or storage.is_finished


def has_index(reader: Reader1 | Reader2) -> bool:
    """Whether a storage file has an index of its messages; one that is made when it is opened does not count."""
    storage = reader.storage if isinstance(reader, Reader2) else None
    return not isinstance(storage, _McapReader) or (storage.is_finished and bool(storage.chunks))


def _unpack_bag_chunk(name: str, limits: LimitSettings, data: bytes) -> bytes:
    content = unpack_chunk(data, limits.max_unpacked_bytes, DECOMPRESSORS[name])
    check_unpacked_size(len(content), limits)
    return content


def _check_chunks(chunks: Iterable[storage_mcap.ChunkInfo], limits: LimitSettings) -> None:
    """Checks the sizes of chunks, and of all that overlap in time, which are in memory together."""
    changes: list[tuple[int, int]] = []
    for chunk in chunks:
        start, size = chunk.message_start_time, chunk.uncompressed_size
        check_unpacked_size(size, limits)
        changes += [(start, size), (max(start, chunk.message_end_time) + 1, -size)]
    together = 0
    for _, size in sorted(changes):
        together += size
        if together > limits.max_overlapping_bytes:
            raise ValueError(
                f"its chunks that overlap in time unpack to more than the limit of "
                f"{limits.max_overlapping_bytes / 1e6:.0f} MB: it is damaged, or needs "
                "limits.max_overlapping_bytes in the settings"
            )

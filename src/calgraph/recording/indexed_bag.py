"""ROS 1 bags, in time that grows with their size only.

rosbags unpacks a chunk whenever the next message is in another one: at every message where the topics were written
one after the other. And it follows an index that names one part of a chunk any number of times.
"""

import heapq
import os
from collections.abc import Collection, Generator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, IndexData, RecordType, read_bytes, read_uint32

from calgraph.config.settings import LimitSettings

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

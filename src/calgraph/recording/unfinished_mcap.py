"""MCAP files without an end: their recorder was killed, or they were cut off when they were copied.

Their messages are read up to the last complete chunk. What the recorder would have written at the end, the index
of all chunks, is made from the records before it, of which chunks are passed over.

Source: "MCAP Format Specification", mcap.dev/spec.
"""

import io
import os
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import check_unpacked_size
from calgraph.recording.limited_storage import storage_mcap

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

_MAGIC = b"\x89MCAP0\r\n"
# Operation codes of records; private ones begin at 0x80, and no record has 0.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = range(2, 8)
_CHUNK_INDEX, _STATISTICS, _DATA_END = 0x08, 0x0B, 0x0F
_FIRST_PRIVATE = 0x80
_HEAD = struct.Struct("<BQ")
# Times of the first and the last message, uncompressed size, checksum, and the length of the compression's name.
_CHUNK_HEAD = struct.Struct("<QQQII")
# "zstd" is the longest.
_MAX_COMPRESSION = 16
# Of a message in the index of its chunk: its time and its offset.
_INDEX_ENTRY = 16
# Between the reads in which zeros are passed over, bytes.
_BLOCK = 2**20


class _Record(NamedTuple):
    op: int
    start: int
    """Of its content, bytes from the start of the file."""
    end: int


@dataclass
class _Chunk:
    start: int
    """Of its record in the file, bytes; likewise its length."""
    length: int
    first: int
    """Time of the first message, ns; likewise the last."""
    last: int
    size: int
    """Unpacked, bytes."""
    checksum: int
    compression: str
    packed: tuple[int, int]
    """Where its compressed content begins, and its length, bytes."""
    counts: Counter[int] = field(default_factory=Counter)
    """Messages of each channel."""
    offsets: dict[int, int] = field(default_factory=dict)
    """Where the indices of messages of each channel begin; empty if there are none."""

    @property
    def end(self) -> int:
        """Of its record in the file, bytes."""
        return self.start + self.length


def lacks_end(file: BinaryIO) -> bool:
    """Whether an MCAP does not end as all that are complete do."""
    # It begins with the same bytes.
    if file.seek(0, io.SEEK_END) < 2 * len(_MAGIC):
        return True
    file.seek(-len(_MAGIC), io.SEEK_END)
    return file.read() != _MAGIC


def complete_mcap(file: BinaryIO, limits: LimitSettings) -> BinaryIO:
    """The file up to its last complete chunk, followed by an index of its chunks.

    Args:
        file: an MCAP with a header and without an end. It may still be written to.
        limits: of chunks that are unpacked.

    Raises:
        ValueError: no chunk is complete, or a record before the last is damaged or larger than the limit.
        Exception: anything that rosbags raises for damaged bytes.
    """
    end, tail = _make_tail(file, limits)
    return io.BufferedReader(_SplicedFile(file, b"", end, tail))


def replace_start(file: BinaryIO, content: bytes, position: int) -> BinaryIO:
    """The file with other bytes near its start; the file itself where it has them, or is too short."""
    head, replaced = file.read(position), file.read(len(content))
    end = file.seek(0, io.SEEK_END)
    file.seek(0)
    if replaced == content or len(replaced) < len(content):
        return file
    return io.BufferedReader(_SplicedFile(file, head + content, end, b""))


def finish_mcap(path: Path, limits: LimitSettings) -> None:
    """Gives an MCAP the end that it lacks; what follows its last complete chunk is removed.

    Raises:
        OSError: it cannot be written.
        ValueError: as for :func:`complete_mcap`.
        Exception: anything that rosbags raises for damaged bytes.
    """
    with path.open("r+b") as file:
        if not lacks_end(file):
            return
        end, tail = _make_tail(file, limits)
        # Two steps: a program that is killed between them leaves a file that can be finished again.
        file.truncate(end)
        file.seek(end)
        file.write(tail)
        file.flush()
        os.fsync(file.fileno())


def _make_tail(file: BinaryIO, limits: LimitSettings) -> tuple[int, bytes]:
    """Where the last complete chunk ends, bytes, and the records that belong behind it."""
    definitions: dict[tuple[int, int], bytes] = {}
    chunks: list[_Chunk] = []
    file.seek(len(_MAGIC))
    _, header = _HEAD.unpack(storage_mcap.read_exact(file, _HEAD.size))
    end, is_chunked = len(_MAGIC) + _HEAD.size + header, True
    for record in _scan_records(file, end):
        end = record.end
        if record.op == _CHUNK:
            chunks.append(_read_chunk_head(file, record, limits))
        elif record.op == _MESSAGE_INDEX and chunks:
            file.seek(record.start)
            (channel,) = struct.unpack("<H", storage_mcap.read_exact(file, 2))
            chunks[-1].counts[channel] += max(record.end - record.start - 6, 0) // _INDEX_ENTRY
            chunks[-1].offsets[channel] = record.start - _HEAD.size
        elif record.op in (_SCHEMA, _CHANNEL):
            file.seek(record.start)
            _add_definition(definitions, record.op, storage_mcap.read_exact(file, record.end - record.start))
        elif record.op == _MESSAGE:
            is_chunked = False
    data_end = _pack(_DATA_END, bytes(4))
    if not is_chunked:
        # There is no index of messages outside of chunks, and they are read without.
        return end, data_end + _pack(_FOOTER, bytes(20)) + _MAGIC
    index = b""
    if chunks:
        # Parts of its index may be missing, or of itself where the system ended before its disk was written to.
        last = chunks.pop()
        with suppress(Exception):
            index = _index_messages(last, _read_messages(file, last, definitions))
            chunks.append(last)
    if not any(chunk.counts for chunk in chunks):
        raise ValueError("ends before its first chunk of messages is complete")
    _find_definitions(file, chunks, definitions)
    footer = _pack(_FOOTER, struct.pack("<QQI", chunks[-1].end + len(index + data_end), 0, 0))
    return chunks[-1].end, index + data_end + _make_summary(chunks, definitions) + footer + _MAGIC


def _scan_records(file: BinaryIO, start: int) -> Iterator[_Record]:
    """The complete records of the data, without their content.

    Raises:
        ValueError: what follows the last is no part of a record.
    """
    size = file.seek(0, io.SEEK_END)
    position = start
    while position + _HEAD.size <= size:
        file.seek(position)
        op, length = _HEAD.unpack(storage_mcap.read_exact(file, _HEAD.size))
        record = _Record(op, position + _HEAD.size, position + _HEAD.size + length)
        if op == _DATA_END:
            return
        if op == 0 and _is_zero(file, position):
            return  # space that the file system reserved
        if not 0 < op <= _DATA_END and op < _FIRST_PRIVATE:
            raise ValueError(f"has no record at byte {position}: it is damaged there")
        if record.end > size:
            # It is the start of one, or has a damaged length.
            if op == _CHUNK and record.start + _CHUNK_HEAD.size + _MAX_COMPRESSION + 8 <= size:
                _read_chunk_head(file, record, None)
            return
        yield record
        position = record.end


def _is_zero(file: BinaryIO, position: int) -> bool:
    file.seek(position)
    while block := file.read(_BLOCK):
        if block.count(0) < len(block):
            return False
    return True


def _read_chunk_head(file: BinaryIO, record: _Record, limits: LimitSettings | None) -> _Chunk:
    """Reads the fields before the content of a chunk; its uncompressed size is checked if limits are given.

    Raises:
        ValueError: its fields contradict its length, or it is larger than the limit.
    """
    file.seek(record.start)
    first, last, size, checksum, name = _CHUNK_HEAD.unpack(storage_mcap.read_exact(file, _CHUNK_HEAD.size))
    if name <= _MAX_COMPRESSION:
        compression = storage_mcap.read_exact(file, name).decode(errors="replace")
        (packed,) = struct.unpack("<Q", storage_mcap.read_exact(file, 8))
        if file.tell() + packed == record.end:
            if limits:
                check_unpacked_size(size, limits)
            start = record.start - _HEAD.size
            place = file.tell(), packed
            return _Chunk(start, record.end - start, first, last, size, checksum, compression, place)
    raise ValueError(
        f"the chunk at byte {record.start - _HEAD.size} states contradictory lengths: it is damaged there"
    )


def _read_messages(
    file: BinaryIO, chunk: _Chunk, definitions: dict[tuple[int, int], bytes]
) -> dict[int, list[tuple[int, int]]]:
    """Time (ns) and offset in the chunk of its messages, by channel; counts them, and adds what it defines."""
    start, length = chunk.packed
    file.seek(start)
    packed = storage_mcap.read_exact(file, length)
    data = storage_mcap.decompress(packed, chunk.compression, chunk.size, chunk.checksum)
    messages: dict[int, list[tuple[int, int]]] = {}
    position = 0
    while position < len(data):
        op, length = _HEAD.unpack_from(data, position)
        content = position + _HEAD.size
        if content + length > len(data):
            raise ValueError(f"a record of the chunk at byte {chunk.start} is longer than the chunk")
        if op == _MESSAGE:
            channel, time = struct.unpack_from("<H4xQ", data, content)
            messages.setdefault(channel, []).append((time, position))
        elif op in (_SCHEMA, _CHANNEL):
            _add_definition(definitions, op, data[content : content + length])
        position = content + length
    chunk.counts = Counter({channel: len(entries) for channel, entries in messages.items()})
    return messages


def _index_messages(chunk: _Chunk, messages: dict[int, list[tuple[int, int]]]) -> bytes:
    """The indices of a chunk's messages, as records that follow it."""
    records = b""
    chunk.offsets = {}
    for channel, entries in messages.items():
        chunk.offsets[channel] = chunk.end + len(records)
        packed = b"".join(struct.pack("<QQ", *entry) for entry in entries)
        records += _pack(_MESSAGE_INDEX, struct.pack("<HI", channel, len(packed)) + packed)
    return records


def _find_definitions(file: BinaryIO, chunks: list[_Chunk], definitions: dict[tuple[int, int], bytes]) -> None:
    """Reads the definitions of all channels that have messages from the chunks that define them.

    A channel is defined in the chunk of its first message, or in an earlier one.
    """
    others = []
    for chunk in chunks:
        if not chunk.counts or any((_CHANNEL, channel) not in definitions for channel in chunk.counts):
            _read_messages(file, chunk, definitions)
        else:
            others.append(chunk)
    used = {channel for chunk in chunks for channel in chunk.counts}
    for chunk in others:
        if all((_CHANNEL, channel) in definitions for channel in used):
            break
        _read_messages(file, chunk, definitions)


def _add_definition(definitions: dict[tuple[int, int], bytes], op: int, content: bytes) -> None:
    """Adds a schema or channel; the first of a number holds, as it may be repeated but not changed."""
    definitions.setdefault((op, *struct.unpack_from("<H", content)), content)


def _make_summary(chunks: list[_Chunk], definitions: dict[tuple[int, int], bytes]) -> bytes:
    total: Counter[int] = sum((chunk.counts for chunk in chunks), Counter())
    filled = [chunk for chunk in chunks if chunk.counts]
    first, last = min(chunk.first for chunk in filled), max(chunk.last for chunk in filled)
    numbers = [sum(op == kind for op, _ in definitions) for kind in (_SCHEMA, _CHANNEL)]
    statistics = struct.pack("<QHIIIIQQ", total.total(), *numbers, 0, 0, len(chunks), first, last)
    return b"".join(
        [
            *(_pack(op, content) for (op, _), content in sorted(definitions.items())),
            _pack(_STATISTICS, statistics + _pack_map(total)),
            *(_pack(_CHUNK_INDEX, _index_chunk(chunk)) for chunk in filled),
        ]
    )


def _index_chunk(chunk: _Chunk) -> bytes:
    """The content of the index record of a chunk.

    Readers take the numbers of messages from the lengths of their indices: where a chunk has none, they are stated
    as though they followed it.
    """
    offsets = dict(chunk.offsets)
    after = chunk.end
    for channel, count in chunk.counts.items():
        offsets.setdefault(channel, after)
        after += _HEAD.size + 6 + _INDEX_ENTRY * count
    name = chunk.compression.encode()
    return (
        struct.pack("<QQQQ", chunk.first, chunk.last, chunk.start, chunk.length)
        + _pack_map(offsets)
        + struct.pack("<QI", after - chunk.end, len(name))
        + name
        + struct.pack("<QQ", chunk.packed[1], chunk.size)
    )


def _pack_map(values: dict[int, int]) -> bytes:
    entries = b"".join(struct.pack("<HQ", *entry) for entry in values.items())
    return struct.pack("<I", len(entries)) + entries


def _pack(op: int, content: bytes) -> bytes:
    return _HEAD.pack(op, len(content)) + content


class _SplicedFile(io.RawIOBase):
    """A file up to a position, followed by bytes in memory; other bytes may be in place of its first ones."""

    def __init__(self, file: BinaryIO, head: bytes, end: int, tail: bytes) -> None:
        self._file, self._head, self._end, self._tail = file, head, end, tail
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        origins = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._end + len(self._tail)}
        position = origins[whence] + offset
        if position < 0:
            raise ValueError(f"negative seek position {position}")
        self._position = position
        return position

    def readinto(self, buffer: "WriteableBuffer", /) -> int:
        view: Any = memoryview(buffer).cast("B")
        if self._position < len(self._head):
            data = self._head[self._position : self._position + len(view)]
        elif self._position < self._end:
            self._file.seek(self._position)
            data = self._file.read(min(len(view), self._end - self._position))
        else:
            start = self._position - self._end
            data = self._tail[start : start + len(view)]
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()

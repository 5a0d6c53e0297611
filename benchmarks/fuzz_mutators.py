"""Mutations that keep an input's structure, so that they pass lengths and checksums and reach what is inside.

Each takes an input, a generator of random numbers, and the fuzzer's own mutation of bytes for the leaves; an input
that it cannot parse is left to the latter.
"""

import io
import json
import struct
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from random import Random
from typing import Any

import lz4.frame
import numpy as np
from backports import zstd
from ruamel.yaml import YAML

MutateBytes = Callable[[bytes], bytes]
Mutator = Callable[[bytes, Random, MutateBytes], bytes]

_NUMBERS = (
    0, 1, -1, 2, 0.5, -0.0, 1e-300, 1e300, -1e300, float("nan"), float("inf"), float("-inf"), 2**31,
    2**32 - 1, 2**63, -(2**63), 10**30, 255, 65536, 1e9, 3.0000001,
)  # fmt: skip
_VALUES: tuple[Any, ...] = (
    *_NUMBERS, None, True, False, "", "a", "camera", "lidar", "\x00", "\u2028", "a" * 300, "=1+1", "board",
    "people", [], {}, [0], [1, 2, 3], {"a": 1}, {"kind": "board"}, [[]], "2001-01-01", "nan", "1 mm", "0.3 deg",
)  # fmt: skip


def mutate_yaml(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Values and keys of a YAML file, or its text."""
    if rng.random() < 0.4:
        return inner(data)
    try:
        content = YAML(typ="safe").load(data)
    except Exception:  # no YAML any more
        return inner(data)
    return format_flow(mutate_tree(content, rng)).encode(errors="surrogatepass")


def mutate_tree(content: Any, rng: Random) -> Any:
    """Nested lists and mappings with one place changed."""
    if isinstance(content, dict) and content and rng.random() < 0.9:
        key = rng.choice(list(content))
        roll = rng.random()
        if roll < 0.08:
            return {k: v for k, v in content.items() if k != key}
        if roll < 0.12:
            return {**content, rng.choice(("kind", "a", 1, None, True, str(key)[:-1])): content[key]}
        if roll < 0.16:
            return {**content, key: content[rng.choice(list(content))]}
        return {**content, key: mutate_tree(content[key], rng)}
    if isinstance(content, list) and content and rng.random() < 0.9:
        i = rng.randrange(len(content))
        roll = rng.random()
        if roll < 0.1:
            return content[:i] + content[i + 1 :]
        if roll < 0.2:
            return [*content, content[i]]
        return [*content[:i], mutate_tree(content[i], rng), *content[i + 1 :]]
    if isinstance(content, int | float) and rng.random() < 0.5:
        return rng.choice(
            (content * 1000, -content, content + 1, content / 1000, content * (1 + 1e-9), str(content))
        )
    return rng.choice(_VALUES)


def format_flow(content: Any) -> str:
    """A value in YAML's flow style."""
    if isinstance(content, dict):
        return "{" + ", ".join(f"{format_flow(k)}: {format_flow(v)}" for k, v in content.items()) + "}"
    if isinstance(content, list | tuple):
        return "[" + ", ".join(map(format_flow, content)) + "]"
    if isinstance(content, float) and not np.isfinite(content):
        return ".nan" if np.isnan(content) else ".inf" if content > 0 else "-.inf"
    return json.dumps(content if isinstance(content, int | float | str | None) else str(content))


def mutate_zip(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Members of a ZIP, with their checksums."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:  # no ZIP any more
        return inner(data)
    if not members or rng.random() < 0.05:
        return inner(data)
    i = rng.randrange(len(members))
    name, content = members[i]
    roll = rng.random()
    if roll < 0.05:
        members.pop(i)
    elif roll < 0.1:
        members[i] = (
            rng.choice(members)[0] if roll < 0.08 else inner(name.encode()).decode(errors="replace"),
            content,
        )
    elif name.endswith(".npy"):
        members[i] = (name, mutate_npy(content, rng, inner))
    elif name.endswith(".json"):
        members[i] = (name, mutate_json(content, rng, inner))
    else:
        members[i] = (name, inner(content))
    out = io.BytesIO()
    compression = rng.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED))
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name.replace("\x00", "0") or "a"), content, compression)
    return out.getvalue()


def mutate_json(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Values of a JSON file."""
    try:
        content = json.loads(data)
    except ValueError:
        return inner(data)
    return inner(data) if rng.random() < 0.1 else json.dumps(mutate_tree(content, rng), default=str).encode()


def mutate_npy(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """The header, the shape or single values of an array."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False).copy()
    except Exception:  # no array any more
        return inner(data)
    roll = rng.random()
    if roll < 0.1:
        return inner(data)
    if roll < 0.3:
        array = np.atleast_1d(array)
        array = rng.choice((array[:0], array[:-1], array.repeat(2, axis=0), array.ravel()))
    elif array.size:
        # Not every number and type can be written into every array.
        with suppress(OverflowError, ValueError, TypeError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if roll < 0.4:
                array = array.astype(rng.choice(("<f4", "<i8", "<f8", "|b1", "<U3", ">f8", "<c16", "|S2")))
            else:
                array.reshape(-1)[rng.randrange(array.size)] = rng.choice(_NUMBERS)
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=False)
    return out.getvalue()


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _CHUNK_INDEX, _DATA_END, _FOOTER, _MESSAGE_INDEX = 0x06, 0x08, 0x0F, 0x02, 0x07
_Records = list[tuple[int, bytes]]
_UNPACK: dict[str, Callable[[bytes], Any]] = {"": bytes, "zstd": zstd.decompress, "lz4": lz4.frame.decompress}
_PACK: dict[str, Callable[[bytes], Any]] = {"": bytes, "zstd": zstd.compress, "lz4": lz4.frame.compress}


def mutate_mcap(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Records of an MCAP, and those in its chunks, with their lengths, offsets and no checksums.

    Source: MCAP specification, mcap.dev.
    """
    if rng.random() < 0.1 or not data.startswith(_MCAP_MAGIC):
        return inner(data)
    records = read_records(data[8:-8])
    if not records:
        return inner(data)
    i = rng.randrange(len(records))
    op, content = records[i]
    roll = rng.random()
    if roll < 0.06:
        records.pop(i)
    elif roll < 0.12:
        records.insert(rng.randrange(len(records)), records[i])
    elif op == _CHUNK:
        records[i] = (op, _mutate_chunk(content, rng, inner))
    else:
        records[i] = (op, inner(content))
    return _pack_mcap(records, rng)


def read_records(data: bytes) -> _Records:
    """The records of an MCAP, or of a chunk, by operation code; lengths beyond the end are cut."""
    records, position = [], 0
    while position + 9 <= len(data):
        op, size = struct.unpack_from("<BQ", data, position)
        records.append((op, data[position + 9 : position + 9 + size]))
        position += 9 + size
    return records


def pack_records(records: _Records) -> bytes:
    """The records with their lengths."""
    return b"".join(struct.pack("<BQ", op, len(content)) + content for op, content in records)


def _mutate_chunk(content: bytes, rng: Random, inner: MutateBytes) -> bytes:
    try:
        start, end, _size, _crc, length = struct.unpack_from("<QQQII", content)
        compression = content[32 : 32 + length].decode()
        plain: bytes = _UNPACK[compression](content[40 + length :])
    except Exception:  # no chunk any more
        return inner(content)
    records = read_records(plain)
    if records and rng.random() < 0.9:
        i = rng.randrange(len(records))
        records[i] = (records[i][0], inner(records[i][1]))
        plain = pack_records(records)
    else:
        plain = inner(plain)
    name = rng.choice(("", "zstd", "lz4"))
    packed: bytes = _PACK[name](plain)
    size = len(plain) if rng.random() < 0.9 else rng.choice((0, 1, len(plain) + 1, 2**40, 2**63))
    head = struct.pack("<QQQII", start, end, size, 0, len(name)) + name.encode()
    return head + struct.pack("<Q", len(packed)) + packed


def _pack_mcap(records: _Records, rng: Random) -> bytes:
    """The file, with the offsets of the summary and of chunks as they are now; at times without a summary."""
    end = next((i for i, (op, _) in enumerate(records) if op == _DATA_END), len(records) - 1)
    data, summary = records[: end + 1], [r for r in records[end + 1 :] if r[0] != _FOOTER]
    if rng.random() < 0.15:
        return _MCAP_MAGIC + pack_records([*data, (_FOOTER, bytes(20))]) + _MCAP_MAGIC
    if rng.random() < 0.9:
        summary = [(op, _reindex(content, data) if op == _CHUNK_INDEX else content) for op, content in summary]
    body = _MCAP_MAGIC + pack_records(data)
    footer = (_FOOTER, struct.pack("<QQI", len(body), 0, 0))
    return body + pack_records([*summary, footer]) + _MCAP_MAGIC


def _reindex(content: bytes, data: _Records) -> bytes:
    """A chunk's index with the place and the sizes of the first chunk."""
    position = 8
    for i, (op, chunk) in enumerate(data):
        if op == _CHUNK and len(chunk) >= 32 and len(content) >= 36:
            (names,) = struct.unpack_from("<I", content, 32)
            if len(content) < 36 + names + 12:
                return content
            indexes = [record for record in data[i + 1 :] if record[0] == _MESSAGE_INDEX]
            start, end, size, _crc, length = struct.unpack_from("<QQQII", chunk)
            place = struct.pack("<QQQQ", start, end, position, 9 + len(chunk))
            offsets = content[32 : 36 + names]
            tail = (
                struct.pack("<QI", sum(9 + len(index) for _, index in indexes), length) + chunk[32 : 32 + length]
            )
            return place + offsets + tail + struct.pack("<QQ", max(0, len(chunk) - 40 - length), size)
        position += 9 + len(chunk)
    return content


def mutate_bag1(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Records of a ROS 1 bag, with their lengths; offsets of later records are corrected by what was inserted.

    Source: "Bags/Format/2.0", wiki.ros.org.
    """
    line, _, rest = data.partition(b"\n")
    records = []
    position = 0
    while position + 8 <= len(rest):
        (length,) = struct.unpack_from("<I", rest, position)
        head = rest[position + 4 : position + 4 + length]
        position += 4 + length
        if position + 4 > len(rest):
            break
        (length,) = struct.unpack_from("<I", rest, position)
        records.append([head, rest[position + 4 : position + 4 + length]])
        position += 4 + length
    if rng.random() < 0.1 or len(records) < 2:
        return inner(data)
    i = rng.randrange(1, len(records))
    part = rng.randrange(2)
    old = sum(8 + len(a) + len(b) for a, b in records[:i])
    before = len(records[i][0]) + len(records[i][1])
    records[i][part] = _mutate_fields(records[i][0], rng, inner) if part == 0 else inner(records[i][1])
    added = len(records[i][0]) + len(records[i][1]) - before
    for record in records:
        record[0] = _shift_offsets(record[0], len(line) + 1 + old, added)
    return line + b"\n" + b"".join(
        struct.pack("<I", len(a)) + a + struct.pack("<I", len(b)) + b for a, b in records
    )  # fmt: skip


def _fields(head: bytes) -> list[bytes]:
    fields, position = [], 0
    while position + 4 <= len(head):
        (length,) = struct.unpack_from("<I", head, position)
        fields.append(head[position + 4 : position + 4 + length])
        position += 4 + length
    return fields


def _pack_fields(fields: list[bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(field)) + field for field in fields)


def _mutate_fields(head: bytes, rng: Random, inner: MutateBytes) -> bytes:
    fields = _fields(head)
    if not fields:
        return inner(head)
    i = rng.randrange(len(fields))
    name, _, value = fields[i].partition(b"=")
    fields[i] = name + b"=" + inner(value)
    return _pack_fields(fields)


def _shift_offsets(head: bytes, limit: int, added: int) -> bytes:
    """Positions of the index and of chunks that are behind a change."""
    fields = _fields(head)
    for i, field in enumerate(fields):
        name, _, value = field.partition(b"=")
        if name in (b"index_pos", b"chunk_pos") and len(value) == 8:
            (place,) = struct.unpack("<Q", value)
            if place > limit:
                fields[i] = name + b"=" + struct.pack("<Q", (place + added) % 2**64)
    return _pack_fields(fields)

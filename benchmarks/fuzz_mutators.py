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
Parts = list[tuple[str, bytes]]
"""Of a file, with names."""
Unpack = Callable[[bytes], Parts]
Pack = Callable[[Parts], bytes]

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


def mutate_parts(unpack: Unpack, pack: Pack, of_part: Callable[[str], Mutator]) -> Mutator:
    """Mutates one named part of a file by what mutates parts of its name, or drops, repeats or renames it."""

    def mutate(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
        try:
            parts = unpack(data)
        except Exception:  # no such file any more
            return inner(data)
        roll = rng.random()
        if not parts or roll < 0.08:
            return inner(data)
        i = rng.randrange(len(parts))
        name, content = parts[i]
        if roll < 0.12:
            parts.pop(i)
        elif roll < 0.16:
            parts.insert(rng.randrange(len(parts)), parts[i])
        elif roll < 0.2:
            parts[i] = (rng.choice(parts)[0], content)
        else:
            parts[i] = (name, of_part(name)(content, rng, inner))
        return pack(parts)

    return mutate


def mutate_bytes(data: bytes, _rng: Random, inner: MutateBytes) -> bytes:
    """As the fuzzer does."""
    return inner(data)


def keep_size(data: bytes, _rng: Random, inner: MutateBytes) -> bytes:
    """Changed bytes, cut or filled to as many as before: what a file states about later positions remains true."""
    return inner(data)[: len(data)].ljust(len(data), b"\0")


def _unpack_zip(data: bytes) -> Parts:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [(info.filename, archive.read(info)) for info in archive.infolist()]


def _pack_zip(parts: Parts) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        for name, content in parts:
            archive.writestr(zipfile.ZipInfo(name), content)
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


_NESTED: dict[str, Mutator] = {".npy": mutate_npy, ".json": mutate_json}
mutate_zip = mutate_parts(_unpack_zip, _pack_zip, lambda name: _NESTED.get(name[name.rfind(".") :], mutate_bytes))
"""Members of a ZIP, with their checksums."""

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _CHUNK, _DATA_END = 0x02, 0x06, 0x0F
_Records = list[tuple[int, bytes]]
_UNPACK: dict[str, Callable[[bytes], Any]] = {"": bytes, "zstd": zstd.decompress, "lz4": lz4.frame.decompress}
_PACK: dict[str, Callable[[bytes], Any]] = {"": bytes, "zstd": zstd.compress, "lz4": lz4.frame.compress}


def read_records(data: bytes) -> _Records:
    """The records of an MCAP, or of a chunk, by operation code; lengths beyond the end are cut.

    Source: MCAP specification, mcap.dev.
    """
    records, position = [], 0
    while position + 9 <= len(data):
        op, size = struct.unpack_from("<BQ", data, position)
        records.append((op, data[position + 9 : position + 9 + size]))
        position += 9 + size
    return records


def pack_records(records: _Records) -> bytes:
    """The records with their lengths."""
    return b"".join(struct.pack("<BQ", op, len(content)) + content for op, content in records)


def _unpack_records(data: bytes) -> Parts:
    return [(str(op), content) for op, content in read_records(data)]


def _pack_records(parts: Parts) -> bytes:
    return pack_records([(int(name), content) for name, content in parts])


_mutate_records = mutate_parts(_unpack_records, _pack_records, lambda _: mutate_bytes)


def _mutate_chunk(content: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Records of a chunk, compressed in another way at times, without checksum."""
    try:
        times, _size, _crc, length = content[:16], *struct.unpack_from("<QII", content, 16)
        plain: bytes = _UNPACK[content[32 : 32 + length].decode()](content[40 + length :])
    except Exception:  # no chunk any more
        return inner(content)
    plain = _mutate_records(plain, rng, inner)
    name = rng.choice(("", "zstd", "lz4"))
    packed: bytes = _PACK[name](plain)
    size = len(plain) if rng.random() < 0.9 else rng.choice((0, 1, len(plain) + 1, 2**40, 2**63))
    head = times + struct.pack("<QII", size, 0, len(name)) + name.encode()
    return head + struct.pack("<Q", len(packed)) + packed


def _unpack_mcap(data: bytes) -> Parts:
    if not data.startswith(_MCAP_MAGIC):
        raise ValueError("no MCAP")
    return _unpack_records(data[8:-8])


def _pack_data(parts: Parts) -> bytes:
    """A file without a summary, which would state other positions and sizes."""
    ends = [i for i, (name, _) in enumerate(parts) if name == str(_DATA_END)]
    data = parts[: ends[0] + 1] if ends else parts
    return _MCAP_MAGIC + _pack_records([*data, (str(_FOOTER), bytes(20))]) + _MCAP_MAGIC


_mutate_data = mutate_parts(
    _unpack_mcap, _pack_data, lambda name: _mutate_chunk if name == str(_CHUNK) else mutate_bytes
)
_mutate_indexed = mutate_parts(
    _unpack_mcap, lambda parts: _MCAP_MAGIC + _pack_records(parts) + _MCAP_MAGIC, lambda _: keep_size
)


def mutate_mcap(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Records of an MCAP: with those in its chunks and without a summary, or with a summary that remains true."""
    return rng.choice((_mutate_data, _mutate_indexed))(data, rng, inner)


def _unpack_lengths(data: bytes) -> Parts:
    """What follows lengths of four bytes; none where these do not fit."""
    parts, position = [], 0
    while position < len(data):
        (length,) = struct.unpack_from("<I", data, position)
        parts.append(("", data[position + 4 : position + 4 + length]))
        position += 4 + length
    return parts


def _pack_lengths(parts: Parts) -> bytes:
    return b"".join(struct.pack("<I", len(content)) + content for _, content in parts)


def _unpack_bag1(data: bytes) -> Parts:
    line, _, rest = data.partition(b"\n")
    parts = _unpack_lengths(rest)
    return [("line", line), *((("head", "data")[i % 2], content) for i, (_, content) in enumerate(parts))]


def _pack_bag1(parts: Parts) -> bytes:
    lines = [content for name, content in parts if name == "line"]
    return b"".join(lines) + b"\n" + _pack_lengths([part for part in parts if part[0] != "line"])


_mutate_fields = mutate_parts(_unpack_lengths, _pack_lengths, lambda _: keep_size)
mutate_bag1 = mutate_parts(_unpack_bag1, _pack_bag1, lambda name: _mutate_fields if name == "head" else keep_size)
"""Records of a ROS 1 bag, and fields of their heads ("Bags/Format/2.0", wiki.ros.org)."""

"""PCD files: ascii, binary and binary_compressed, with any fields."""

import gzip
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import check_point_count, check_unpacked_size
from calgraph.recording.point_cloud_columns import Columns

# By TYPE, NumPy's code and the SIZEs that exist, bytes.
_CODES = {"F": ("f", (4, 8)), "I": ("i", (1, 2, 4, 8)), "U": ("u", (1, 2, 4, 8))}
# Maximum size of one point, bytes: the largest descriptors of PCL have some kilobytes.
_MAX_POINT_BYTES = 2**16


def read_pcd(path: Path, limits: LimitSettings = LimitSettings()) -> Columns:
    """The columns (N,) of a PCD file, which may be gzipped; of a field with several values, the first.

    Source: "The PCD (Point Cloud Data) file format", version 0.7, pointclouds.org.

    Raises:
        ValueError: the header or the data are damaged, or unpack to more than the limit.
        OSError: the file cannot be read.
    """
    data = _unpack(path, limits) if path.suffix == ".gz" else path.read_bytes()
    header, body = _split(data)
    dtype = _dtype(header)
    n = _count_points(header)
    check_point_count(n, limits)
    kind = " ".join(header["DATA"]).lower()
    if kind == "ascii":
        return _ascii(body, dtype, n)
    if kind == "binary":
        return _columns(np.frombuffer(_take_exactly(body, n * dtype.itemsize), dtype, n))
    if kind == "binary_compressed":
        return _by_field(body, dtype, n, limits)
    raise ValueError(f"DATA {kind} is unknown; ascii, binary and binary_compressed are known")


def _unpack(path: Path, limits: LimitSettings) -> bytes:
    with gzip.open(path) as file:
        data = file.read(limits.max_unpacked_bytes + 1)
    check_unpacked_size(len(data), limits)
    return data


def decompress_lzf(data: bytes, size: int) -> bytes:
    """Decompresses liblzf's format.

    Args:
        data: compressed bytes.
        size: number of bytes expected.

    Raises:
        ValueError: the data are damaged.
    """
    out = bytearray()
    i = 0
    while i < len(data) and len(out) <= size:
        control = data[i]
        i += 1
        if control < 32:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        start = len(out) - ((control & 31) << 8) - data[i] - 1
        i += 1
        if start < 0:
            raise ValueError("compressed data refer to bytes before their start")
        length += 2
        copied = out[start : start + length]
        # A copy may run into the bytes it has just written: then it repeats them.
        out += (copied * (length // len(copied) + 1))[:length]
    return _take_exactly(bytes(out), size)


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = data.find(b"\n", position)
        if end < 0:
            raise ValueError("is no PCD file: its header has no DATA line")
        words = data[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in header:
            raise ValueError(f"the PCD header has no {key}")
    return header, data[position:]


def _dtype(header: dict[str, list[str]]) -> np.dtype[Any]:
    names, kinds = header["FIELDS"], [kind.upper() for kind in header["TYPE"]]
    sizes = _whole_numbers(header, "SIZE")
    counts = _whole_numbers(header, "COUNT") if "COUNT" in header else [1] * len(names)
    if not len(names) == len(kinds) == len(sizes) == len(counts):
        raise ValueError(f"SIZE, TYPE and COUNT of the PCD header must have {len(names)} values, as FIELDS has")
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        if kind not in _CODES or size not in _CODES[kind][1] or count < 1:
            raise ValueError(
                f"field {name} has TYPE {kind}, SIZE {size} and COUNT {count}; known are F of 4 or 8 bytes, I and "
                "U of 1, 2, 4 or 8, and counts from 1 on"
            )
    total = sum(size * count for size, count in zip(sizes, counts, strict=True))
    if total > _MAX_POINT_BYTES:
        raise ValueError(f"a point has {total} bytes, more than the limit of {_MAX_POINT_BYTES}")
    # PCL pads with fields that are all called _.
    unique = [f"_{i}" if name == "_" or name in names[:i] else name for i, name in enumerate(names)]
    return np.dtype(
        [
            (name, f"<{_CODES[kind][0]}{size}", (count,))
            for name, kind, size, count in zip(unique, kinds, sizes, counts, strict=True)
        ]
    )


def _count_points(header: dict[str, list[str]]) -> int:
    keys = ("POINTS",) if "POINTS" in header else ("WIDTH", "HEIGHT")
    values = [value for key in keys for value in _whole_numbers(header, key)]
    if len(values) != len(keys) or min(values) < 0:
        raise ValueError(f"{' and '.join(keys)} of the PCD header must be 0 or more, got {values}")
    return math.prod(values)


def _whole_numbers(header: dict[str, list[str]], key: str) -> list[int]:
    words = header.get(key, [])
    # Longer ones are no sizes or counts, and take quadratic time.
    if not words or not all(re.fullmatch(r"-?\d{1,18}", word) for word in words):
        raise ValueError(f"{key} of the PCD header must be whole numbers, got {' '.join(words)[:40]!r}")
    return [int(word) for word in words]


def _ascii(body: bytes, dtype: np.dtype[Any], n: int, what: str = "points") -> Columns:
    if n == 0:
        return _columns(np.empty(0, dtype))
    if n > len(body):
        raise ValueError(f"is cut short: {len(body)} bytes of {what}, states {n} {what}")
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=n)
    names = dtype.names or ()
    firsts = np.cumsum([0] + [dtype[name].shape[0] for name in names])
    if table.shape != (n, firsts[-1]):
        raise ValueError(f"has {table.shape[0]} {what} of {table.shape[1]} values, states {n} of {firsts[-1]}")
    return {
        name: table[:, first].astype(dtype[name].base)
        for name, first in zip(names, firsts[:-1], strict=True)
        # An unsigned field may be written as nan by careless tools; only floats are converted as they are.
        if dtype[name].base.kind == "f" or np.isfinite(table[:, first]).all()
    }


def _by_field(body: bytes, dtype: np.dtype[Any], n: int, limits: LimitSettings) -> Columns:
    """Compressed data hold all values of the first field, then all of the second, and so on."""
    packed, size = (int(value) for value in np.frombuffer(_take_exactly(body, 8), "<u4", 2))
    if size != n * dtype.itemsize:
        raise ValueError(f"has {size} bytes of points, states {n} points of {dtype.itemsize} bytes")
    check_unpacked_size(size, limits)
    plain = decompress_lzf(_take_exactly(body[8:], packed), size)
    columns: dict[str, NDArray[Any]] = {}
    position = 0
    for name in dtype.names or ():
        field = dtype[name]
        values = np.frombuffer(plain, field.base, n * field.shape[0], position)
        columns[name] = values.reshape(n, -1)[:, 0] if n else values
        position += n * field.itemsize
    return columns


def _columns(points: NDArray[Any]) -> Columns:
    return {name: points[name][:, 0] for name in points.dtype.names or ()}


def _take_exactly(data: bytes, size: int, what: str = "points") -> bytes:
    if len(data) < size:
        raise ValueError(f"is cut short: {len(data)} bytes of {what}, {size} expected")
    return data[:size]


_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path, limits: LimitSettings = LimitSettings()) -> Columns:
    """The properties (N,) of the vertices of a PLY file.

    Raises:
        ValueError: the file is damaged, or its vertices are not its first element or hold lists.
        OSError: the file cannot be read.
    """
    data = path.read_bytes()
    header, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise ValueError("is no PLY file")
    body = body.partition(b"\n")[2]
    lines = [line.split() for line in header.decode("ascii", errors="replace").splitlines()]
    kind = next((" ".join(words[1:2]) for words in lines if words[:1] == ["format"]), "")
    if kind not in _ORDERS:
        raise ValueError(f"PLY format {kind or 'of no name'} is unknown; known are {', '.join(_ORDERS)}")
    n, dtype = _vertices(lines, _ORDERS[kind])
    check_point_count(n, limits)
    if kind == "ascii":
        return _ascii(body, dtype, n, "vertices")
    return _columns(np.frombuffer(_take_exactly(body, n * dtype.itemsize, "vertices"), dtype, n))


def _vertices(lines: list[list[str]], order: str) -> tuple[int, np.dtype[Any]]:
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if first[1:2] != ["vertex"] or not re.fullmatch(r"\d{1,18}", " ".join(first[2:])):
        raise ValueError(
            f"the first element of the PLY file must be vertex and its number, got {' '.join(first[1:4])!r}"
        )
    end = elements[1] if len(elements) > 1 else len(lines)
    properties = [words[1:] for words in lines[elements[0] + 1 : end] if words[:1] == ["property"]]
    if any(words[:1] == ["list"] for words in properties):
        raise ValueError("vertices with list properties are not supported")
    wrong = [" ".join(words) for words in properties if len(words) != 2 or words[0] not in _TYPES]
    names = ["".join(words[1:]) for words in properties]
    if wrong or len(set(names)) < len(names):
        raise ValueError(
            f"properties of PLY vertices must have a type and different names, got {', '.join(wrong or names)}"
        )
    return int(first[2]), np.dtype([(name, order + _TYPES[kind], (1,)) for kind, name in properties])

"""PCD files: ascii, binary and binary_compressed, with any fields."""

import gzip
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.recording.point_cloud_columns import Columns

_CODES = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path) -> Columns:
    """The columns (N,) of a PCD file, which may be gzipped; of a field with several values, the first.

    Source: "The PCD (Point Cloud Data) file format", version 0.7, pointclouds.org.

    Raises:
        ValueError: the header or the data are damaged.
        OSError: the file cannot be read.
    """
    data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    header, body = _split(data)
    dtype = _dtype(header)
    n = int(header["POINTS"][0] if "POINTS" in header else _product(header))
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        return _ascii(body, dtype, n)
    if kind == "binary":
        return _columns(np.frombuffer(_take_exactly(body, n * dtype.itemsize), dtype, n))
    if kind == "binary_compressed":
        return _by_field(body, dtype, n)
    raise ValueError(f"DATA {kind} is unknown; ascii, binary and binary_compressed are known")


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
    while i < len(data):
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
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    # PCL pads with fields that are all called _.
    unique = [f"_{i}" if name == "_" or name in names[:i] else name for i, name in enumerate(names)]
    return np.dtype(
        [
            (name, f"<{_CODES[kind.upper()]}{size}", (int(count),))
            for name, kind, size, count in zip(unique, header["TYPE"], header["SIZE"], counts, strict=True)
        ]
    )


def _product(header: dict[str, list[str]]) -> int:
    return int(header["WIDTH"][0]) * int(header["HEIGHT"][0])


def _ascii(body: bytes, dtype: np.dtype[Any], n: int) -> Columns:
    if n == 0:
        return _columns(np.empty(0, dtype))
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=n)
    names = dtype.names or ()
    firsts = np.cumsum([0] + [dtype[name].shape[0] for name in names])
    if table.shape != (n, firsts[-1]):
        raise ValueError(f"has {table.shape[0]} points of {table.shape[1]} values, not {n} of {firsts[-1]}")
    return {
        name: table[:, first].astype(dtype[name].base)
        for name, first in zip(names, firsts[:-1], strict=True)
        # An unsigned field may be written as nan by careless tools; only floats are converted as they are.
        if dtype[name].base.kind == "f" or np.isfinite(table[:, first]).all()
    }


def _by_field(body: bytes, dtype: np.dtype[Any], n: int) -> Columns:
    """Compressed data hold all values of the first field, then all of the second, and so on."""
    packed, size = (int(value) for value in np.frombuffer(_take_exactly(body, 8), "<u4", 2))
    if size != n * dtype.itemsize:
        raise ValueError(f"has {size} bytes of points, states {n} points of {dtype.itemsize} bytes")
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


def _take_exactly(data: bytes, size: int) -> bytes:
    if len(data) < size:
        raise ValueError(f"is cut short: {len(data)} bytes of points, {size} expected")
    return data[:size]

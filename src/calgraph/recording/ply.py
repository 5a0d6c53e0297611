"""PLY files: the vertices of ascii and binary ones."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import check_point_count
from calgraph.recording.point_cloud_columns import Columns

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
        names = dtype.names or ()
        if n > len(body):
            raise ValueError(f"is cut short: {len(body)} bytes of vertices, states {n} vertices")
        table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=n) if n else np.zeros((0, len(names)))
        if table.shape != (n, len(names)):
            raise ValueError(
                f"has {table.shape[0]} vertices of {table.shape[1]} values, states {n} of {len(names)}"
            )
        return {name: table[:, i].astype(dtype[name]) for i, name in enumerate(names)}
    if len(body) < n * dtype.itemsize:
        raise ValueError(f"is cut short: {len(body)} bytes of vertices, {n * dtype.itemsize} expected")
    vertices = np.frombuffer(body, dtype, n)
    return {name: vertices[name] for name in dtype.names or ()}


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
    return int(first[2]), np.dtype([(name, order + _TYPES[kind]) for kind, name in properties])

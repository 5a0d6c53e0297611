"""Foxglove's messages, serialised as Protocol Buffers or as JSON: the fields that a sensor's messages have.

Sources: the schemas at github.com/foxglove/foxglove-sdk, whose field numbers never change, and "Encoding",
protobuf.dev. ROS messages of the same names (foxglove_msgs) have the same fields.
"""

import base64
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

_Kind = str | list[Any] | dict[int, Any]
_Fields = dict[int, tuple[str, _Kind]]
"""By number, a field's name and kind: a word, the fields of a message, or a list with these of repeated ones."""

_TIME: _Fields = {1: ("sec", "integer"), 2: ("nanosec", "integer")}
_VECTOR: _Fields = {1: ("x", "double"), 2: ("y", "double"), 3: ("z", "double"), 4: ("w", "double")}
_POSE: _Fields = {1: ("position", _VECTOR), 2: ("orientation", _VECTOR)}
_PACKED: _Fields = {1: ("name", "text"), 2: ("offset", "integer"), 3: ("type", "integer")}
_SCHEMAS: Mapping[str, _Fields] = {
    "CompressedImage": {
        1: ("timestamp", _TIME), 4: ("frame_id", "text"), 2: ("data", "bytes"), 3: ("format", "text"),
    },
    "CompressedVideo": {
        1: ("timestamp", _TIME), 2: ("frame_id", "text"), 3: ("data", "bytes"), 4: ("format", "text"),
    },
    "RawImage": {
        1: ("timestamp", _TIME), 7: ("frame_id", "text"), 2: ("width", "integer"), 3: ("height", "integer"),
        4: ("encoding", "text"), 5: ("step", "integer"), 6: ("data", "bytes"),
    },
    "PointCloud": {
        1: ("timestamp", _TIME), 2: ("frame_id", "text"), 3: ("pose", _POSE), 4: ("point_stride", "integer"),
        5: ("fields", [_PACKED]), 6: ("data", "bytes"),
    },
    "LaserScan": {
        1: ("timestamp", _TIME), 2: ("frame_id", "text"), 3: ("pose", _POSE), 4: ("start_angle", "double"),
        5: ("end_angle", "double"), 6: ("ranges", "doubles"),
    },
    "CameraCalibration": {
        1: ("timestamp", _TIME), 9: ("frame_id", "text"), 2: ("width", "integer"), 3: ("height", "integer"),
        4: ("distortion_model", "text"), 5: ("D", "doubles"), 6: ("K", "doubles"),
    },
}  # fmt: skip
# Of messages inside a message: each is an object. Clouds have one for each of their some ten fields.
_MAX_PARTS = 1000
_JSON_NAMES = {"nanosec": ("nsec", "nanos"), "sec": ("sec", "seconds")}
_EMPTY: Mapping[str, Any] = {"integer": 0, "double": 0.0, "text": "", "bytes": b"", "doubles": b""}


def is_foxglove(name: str) -> bool:
    """Whether messages of a type have Foxglove's fields, by either name of the type."""
    package, _, short = name.replace("/msg/", ".").rpartition(".")
    return package in ("foxglove", "foxglove_msgs") and short in _SCHEMAS


def decode_foxglove(raw: bytes, name: str, encoding: str) -> Any:
    """The message as an object with the fields above, those that are not set zero or empty.

    Raises:
        ValueError: the type or the serialisation is not known, or the bytes do not fit it.
    """
    if not is_foxglove(name) or encoding not in ("protobuf", "json"):
        raise ValueError(f"messages of type {name}, serialised as {encoding}, are not known")
    fields = _SCHEMAS[name.rpartition(".")[2]]
    if encoding == "protobuf":
        return _from_protobuf(memoryview(raw), fields)
    return _from_json(json.loads(raw), fields)


def _from_protobuf(data: memoryview, fields: _Fields) -> SimpleNamespace:
    values: dict[str, Any] = {name: _zero(kind) for name, kind in fields.values()}
    for number, value in _split(data):
        name, kind = fields.get(number, ("", ""))
        if isinstance(kind, list):
            if len(values[name]) >= _MAX_PARTS:
                raise ValueError(f"has more than {_MAX_PARTS} {name}")
            values[name].append(_from_protobuf(_as_bytes(value), kind[0]))
        elif isinstance(kind, dict):
            values[name] = _from_protobuf(_as_bytes(value), kind)
        elif kind == "integer":
            values[name] = value if isinstance(value, int) else int.from_bytes(value, "little")
        elif kind == "double":
            (values[name],) = struct.unpack("<d", _as_bytes(value))
        elif kind == "doubles":  # packed in one field, or one each
            values[name] += bytes(_as_bytes(value))
        elif kind:
            values[name] = str(_as_bytes(value), "utf-8") if kind == "text" else _as_bytes(value)
    doubles = (name for name, kind in fields.values() if kind == "doubles")
    return SimpleNamespace(**values | {name: np.frombuffer(values[name], "<f8") for name in doubles})


def _split(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Numbers of fields, and their values: whole numbers, or their bytes."""
    position = 0
    while position < len(data):
        key, position = _read_integer(data, position)
        if key & 7 == 0:
            value, position = _read_integer(data, position)
            yield key >> 3, value
            continue
        if key & 7 == 2:
            size, position = _read_integer(data, position)
        else:
            size = {1: 8, 5: 4}.get(key & 7, len(data))
        if position + size > len(data):
            raise ValueError(f"is cut short: a field of {size} bytes at byte {position} of {len(data)}")
        yield key >> 3, data[position : position + size]
        position += size


def _read_integer(data: memoryview, position: int) -> tuple[int, int]:
    """A number of up to 64 bits, seven in each byte, and the position after it."""
    value = 0
    for shift in range(0, 64, 7):
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError(f"has a damaged number before byte {position}")


def _as_bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("has a number where its schema has none")
    return value


def _from_json(content: Any, fields: _Fields) -> SimpleNamespace:
    if not isinstance(content, dict):
        raise ValueError("is no JSON object where its schema has one")
    values = {}
    for name, kind in fields.values():
        names = (name, *_JSON_NAMES.get(name, ()))
        value = next((content[one] for one in names if content.get(one) is not None), None)
        values[name] = _zero(kind) if value is None else _convert_json(value, kind)
        if kind == "doubles":
            values[name] = np.asarray(values[name] if value is not None else [], dtype=np.float64).ravel()
    return SimpleNamespace(**values)


def _convert_json(value: Any, kind: _Kind) -> Any:
    if isinstance(kind, list):
        if not isinstance(value, list) or len(value) > _MAX_PARTS:
            raise ValueError(f"has no list of at most {_MAX_PARTS} where its schema has one")
        return [_from_json(one, kind[0]) for one in value]
    if isinstance(kind, dict):
        return _from_json(value, kind)
    if kind == "doubles":
        return [np.nan if one is None else one for one in value]
    return _CONVERSIONS[kind](value)


_CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {
    "integer": int, "double": float, "text": str, "bytes": base64.b64decode,
}  # fmt: skip


def _zero(kind: _Kind) -> Any:
    if isinstance(kind, str):
        return _EMPTY[kind]
    return [] if isinstance(kind, list) else _from_protobuf(memoryview(b""), kind)

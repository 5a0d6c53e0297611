"""Records with arrays in them as one JSON value and a few arrays, to the last bit; without pickle.

All small arrays of one type are in one, in the order in which the JSON value names them. Mappings and tuples
become lists that begin with what they are, records such that begin with the name of their class.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Size, bytes, up to which arrays are joined: reading one from a file takes 0.1 ms, joining one twice its memory.
_MAX_JOINED = 2**16


def encode_records(value: object) -> tuple[Any, dict[str, NDArray[Any]]]:
    """The JSON value and the arrays of plain values, arrays, bytes, tuples, mappings and dataclasses."""
    parts: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)
    content = _encode(value, parts)
    return content, {name: np.concatenate(one) if len(one) > 1 else one[0] for name, one in parts.items()}


def decode_records(content: Any, arrays: Mapping[str, NDArray[Any]], types: Sequence[type] = ()) -> Any:
    """What :func:`encode_records` was given; every array is in C order, and none shares its memory with another.

    Args:
        content: the JSON value.
        arrays: by name.
        types: dataclasses that it may contain.

    Raises:
        LookupError: another class is named, or an array is missing.
        TypeError: the JSON value is none of :func:`encode_records`, or does not fit the fields of a class.
        ValueError: likewise, or an array is too short.
    """
    return _Decoder(arrays, types).decode(content)


def _encode(value: object, parts: defaultdict[str, list[NDArray[Any]]]) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, float):
        # JSON has neither NaN nor infinity.
        parts["float64"].append(np.array([value]))
        return ["float"]
    if isinstance(value, bytes):
        parts["uint8"].append(np.frombuffer(value, np.uint8))
        return ["bytes", len(value)]
    if isinstance(value, np.ndarray):
        name = value.dtype.name if value.nbytes <= _MAX_JOINED else f"large {len(parts)}"
        parts[name].append(value.ravel())
        return ["array", name, *value.shape]
    if isinstance(value, tuple):
        return ["tuple", *(_encode(one, parts) for one in value)]
    if isinstance(value, Mapping):
        return ["mapping", *(_encode(one, parts) for pair in value.items() for one in pair)]
    if is_dataclass(value):
        return [type(value).__name__, *(_encode(getattr(value, field.name), parts) for field in fields(value))]
    raise TypeError(f"{type(value).__name__} is no record")


class _Decoder:
    def __init__(self, arrays: Mapping[str, NDArray[Any]], types: Sequence[type]) -> None:
        self._arrays = arrays
        self._types = {one.__name__: one for one in types}
        self._begin: defaultdict[str, int] = defaultdict(int)

    def decode(self, content: Any) -> Any:
        if not isinstance(content, list):
            return content
        kind, *rest = content
        if kind == "float":
            return self._take("float64", 1).item()
        if kind == "bytes":
            return self._take("uint8", *rest).tobytes()
        if kind == "array":
            name, *shape = rest
            return self._take(name, math.prod(shape)).reshape(shape)
        values = [self.decode(one) for one in rest]
        if kind == "tuple":
            return tuple(values)
        if kind == "mapping":
            return dict(zip(values[::2], values[1::2], strict=True))
        names = (field.name for field in fields(self._types[kind]))
        return self._types[kind](**dict(zip(names, values, strict=True)))

    def _take(self, name: str, count: int) -> NDArray[Any]:
        begin = self._begin[name]
        self._begin[name] += count
        values = self._arrays[name]
        if (begin, count) != (0, len(values)):
            values = values[begin : begin + count].copy()
        if len(values) != count:
            raise ValueError(f"array {name} has no {count} values from {begin} on")
        return values

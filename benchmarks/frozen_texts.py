"""Results of calgraph as text that has every bit of them, for frozen.py.

A text has one line per value: a path, a tab, and the value. Paths consist of names of sensors and fields, so that
two texts of one problem are compared line by line: modules of their types may have any names. Floats are
hexadecimal and exact. What depends on the machine or the time is left out.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.linalg import LinAlgError
from pydantic import BaseModel

from calgraph.errors import CalgraphError, Rejected
from calgraph.result import Calibration
from calgraph.result.sensor_pose import SensorPose

LEFT_OUT = frozenset({
    "pictures", "provenance", "prior_errors", "residuals", "runtime", "seconds", "path", "settings",
})  # fmt: skip
"""Fields with pictures, the version, paths, durations, or what was given; residuals are given as RMS."""
KEYS: Mapping[str, Sequence[str]] = {
    "sensors": ("name", "sensor"),
    "systematic": ("of", "quantity"),
    "edges": ("sensor_a", "sensor_b"),
    "captures": ("capture", "sensor"),
    "axes": ("axis",),
}
"""By which fields the items of a sequence are called, instead of by their position."""


def describe(result: object) -> str:
    """The text of a result: a calibration, or anything made of dataclasses, arrays and numbers."""
    return "".join(f"{path or 'value'}\t{value}\n" for path, value in _lines("", result))


def describe_error(error: Exception) -> str:
    """The text of a refusal, or of an exception that is none of calgraph's."""
    kind = "refusal" if isinstance(error, CalgraphError) else "crash"
    # The words of exceptions of other libraries are theirs.
    text = "" if isinstance(error, LinAlgError) else str(error)
    return f"{kind}\t{json.dumps(type(error).__name__)}\nmessage\t{json.dumps(text, ensure_ascii=False)}\n"


def parse(text: str) -> dict[str, str]:
    """Values by path."""
    return dict(line.split("\t", 1) for line in text.splitlines())


def parse_array(value: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The numbers of an array, flat."""
    _, *numbers = value.split(" ")
    return np.array([float.fromhex(one) for one in numbers])


def _calibration(path: str, found: Calibration) -> Iterator[tuple[str, str]]:
    """The joint covariance block by block: those of sensors are with them, and correlations below."""
    yield from ((at, value) for at, value in _fields(path, found) if at != _join(path, "joint_covariance"))
    names, joint = [sensor.name for sensor in found.sensors], found.joint_covariance
    for k, name in enumerate(names):
        yield _join(path, f"sensors/{name}/covariance"), _array(joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6])
        rest = joint[6 * k : 6 * k + 6, 6 * k + 6 :]
        if np.nan_to_num(rest, nan=1.0).any():
            yield _join(path, f"correlations/{name}"), _array(rest)


def _lines(path: str, value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, Rejected):
        yield path, f"rejected {json.dumps(value.reason, ensure_ascii=False)}"
    elif isinstance(value, BaseModel):
        yield from _lines(path, value.model_dump(mode="json"))
    elif isinstance(value, Calibration):
        yield from _calibration(path, value)
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _fields(path, value)
    elif hasattr(value, "_asdict"):
        yield from _lines(path, {key: one for key, one in value._asdict().items() if key not in LEFT_OUT})
    elif isinstance(value, Mapping):
        if not value:
            yield path, "{}"
        for key, one in value.items():
            yield from _lines(_join(path, _word(key)), one)
    elif isinstance(value, slice):
        yield path, f"{value.start}:{value.stop}:{value.step}"
    elif isinstance(value, np.ndarray):
        yield path, _array(value)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        yield from _sequence(path, value)
    else:
        yield path, _scalar(value)


def _fields(path: str, value: Any) -> Iterator[tuple[str, str]]:
    for name in (one.name for one in fields(value) if one.name not in LEFT_OUT):
        # The covariance of a sensor is among the blocks of the joint one.
        if not (name == "covariance" and isinstance(value, SensorPose)):
            yield from _lines(_join(path, name), getattr(value, name))


def _sequence(path: str, values: Sequence[object]) -> Iterator[tuple[str, str]]:
    if not values:
        yield path, "[]"
    keys = KEYS.get(path.rpartition("/")[2], ())
    counts: dict[str, int] = {}
    for k, value in enumerate(values):
        named = [_word(getattr(value, key)) for key in keys if hasattr(value, key)]
        name = "/".join(named) if named else str(k)
        counts[name] = counts.get(name, 0) + 1
        yield from _lines(_join(path, name if counts[name] == 1 else f"{name}#{counts[name]}"), value)


def _array(values: np.ndarray[Any, Any]) -> str:
    shape = "x".join(map(str, values.shape)) or "scalar"
    return " ".join([shape, *(float(one).hex() for one in values.ravel())])


def _scalar(value: object) -> str:
    if isinstance(value, float | np.floating):
        return float(value).hex()
    if isinstance(value, np.bool_ | np.integer):
        value = value.item()
    return json.dumps(value, ensure_ascii=False)


def _join(path: str, name: str) -> str:
    return f"{path}/{name}" if path else name


def _word(key: object) -> str:
    """A key without what separates paths and values; a tuple of keys as one."""
    text = "+".join(map(_word, key)) if isinstance(key, tuple) else str(key)
    return text.replace("\t", " ").replace("\n", " ").replace("/", "|")

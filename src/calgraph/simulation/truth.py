"""truth.yaml: where the sensors of a simulated robot or network, and its board or people, really were."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.io import save_yaml

_FORMAT = "calgraph-truth/1"


@dataclass(frozen=True, eq=False)
class BoardTruth:
    """One hold of the board."""

    trigger: float
    """Stamp of the start of the hold, s."""
    end: float
    """Stamp of the end of the hold, s."""
    T_root_board: Array
    """(4, 4) at the start of the hold."""
    disturbed: bool
    """Whether the board slipped during the hold."""


@dataclass(frozen=True, eq=False)
class PersonTruth:
    """One person, or cylinder, that walked through a network of scanners."""

    axes: Array
    """(2,) radii across and along its heading, m."""
    times: Array
    """(K,) evenly spaced, s, root's clock."""
    positions: Array
    """(K, 2) of its centre in the root's plane, m."""
    headings: Array
    """(K,) direction of its walk, counter-clockwise from the root's x, rad."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a calibration of a simulated recording ought to find."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor."""
    boards: tuple[BoardTruth, ...]
    """One for each capture, in order."""
    clock_offsets: Mapping[str, float] = field(default_factory=dict)
    """By sensor, its clock minus the root's, s; empty for a robot."""
    people: tuple[PersonTruth, ...] = ()
    """Those who walked through a network."""


def save_truth(path: Path, truth: Truth) -> None:
    """Writes a truth.yaml; its ``sensors`` have the layout of calibration.yaml."""
    sensors: dict[str, Any] = {}
    for name, T_root_sensor in truth.T_root_sensor.items():
        parent = {} if name == truth.root else {"parent": truth.root}
        offset = {"clock_offset": truth.clock_offsets[name]} if name in truth.clock_offsets else {}
        sensors[name] = {**parent, **_plain(T_root_sensor), **offset}
    captures = [
        {"trigger": b.trigger, "end": b.end, "disturbed": b.disturbed, **_plain(b.T_root_board)}
        for b in truth.boards
    ]
    content = {"format": _FORMAT, "root": truth.root, "sensors": sensors, "captures": captures}
    if truth.people:
        content["people"] = [_plain_person(person) for person in truth.people]
    save_yaml(path, content)


def load_truth(path: Path) -> Truth:
    """Reads a truth.yaml.

    Raises:
        InputError: the file is missing or is not a truth.yaml.

    """
    try:
        content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise InputError(f"{path}: is not a truth.yaml; its format must be {_FORMAT}")
        return Truth(
            content["root"],
            {name: _pose(entry) for name, entry in content["sensors"].items()},
            tuple(
                BoardTruth(entry["trigger"], entry["end"], _pose(entry), entry["disturbed"])
                for entry in content["captures"]
            ),
            {name: entry["clock_offset"] for name, entry in content["sensors"].items() if "clock_offset" in entry},
            tuple(_person(entry) for entry in content.get("people", ())),
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is not valid YAML: {' '.join(str(error).split())}") from error
    except KeyError as error:
        raise InputError(f"{path}: the key {error.args[0]!r} is missing") from error


def _plain(T: Array) -> dict[str, list[float]]:
    return {"translation": T[:3, 3].tolist(), "rotation": so3.quaternion(T[:3, :3]).tolist()}


def _pose(entry: Mapping[str, Any]) -> Array:
    return se3.from_xyz_quaternion(entry["translation"], entry["rotation"])


def _plain_person(person: PersonTruth) -> dict[str, Any]:
    """Its samples as a start, an interval, and x, y, heading to a hundredth of a millimetre."""
    path = np.column_stack([person.positions, person.headings]).round(5)
    interval = float(np.diff(person.times[:2]).sum().round(6))
    start = float(person.times[0]) if len(person.times) else 0.0
    return {"axes": person.axes.tolist(), "start": start, "interval": interval, "path": path.tolist()}


def _person(entry: Mapping[str, Any]) -> PersonTruth:
    path = np.array(entry["path"], dtype=np.float64).reshape(-1, 3)
    times = entry["start"] + entry["interval"] * np.arange(len(path))
    return PersonTruth(np.array(entry["axes"], dtype=np.float64), times, path[:, :2], path[:, 2])

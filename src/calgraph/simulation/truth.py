"""truth.yaml: true poses of the sensors of a simulated robot or network, and of its board or people."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.io.archive import read_archive, write_archive
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml

_FORMAT = "calgraph-truth/1"
_PEOPLE_FORMAT, _PEOPLE_MEMBER = "calgraph-truth-people/1", "people.json"
_MAX_SAMPLES = 20_000
"""Of people's paths in truth.yaml, which takes 0.3 ms each to write; more are written to an archive beside it."""
_MAX_ARCHIVE_BYTES = 10**10
"""Of that archive: 24 bytes a sample, 20 samples a second, for 1000 people over five hours."""
# Simulate writes quaternions with all digits; a person may type three decimals.
_MAX_LENGTH_ERROR = 2e-3


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
    """True trajectory of one person, or cylinder, in a network of scanners."""

    axes: Array
    """(2,) radii across and along its heading, m."""
    times: Array
    """(K,) evenly spaced, s, root's clock."""
    positions: Array
    """(K, 2) of the centre in the root's plane, m."""
    headings: Array
    """(K,) direction of the walk, counter-clockwise from the root's x, rad."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The ground truth of a simulated recording."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor."""
    boards: tuple[BoardTruth, ...]
    """One for each capture, in order."""
    clock_offsets: Mapping[str, float] = field(default_factory=dict)
    """By sensor, the sensor's clock minus the root's, s, in the middle of the recording; empty for a robot."""
    people: tuple[PersonTruth, ...] = ()
    """The moving bodies of a network."""
    errors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By sensor of a network or of a drive, what is wrong with it."""
    T_base_root: Array | None = None
    """(4, 4) of the root on a vehicle, in the frame on the floor below the centre of its rear axle."""


def save_truth(path: Path, truth: GroundTruth) -> None:
    """Writes a truth.yaml; its ``sensors`` have the layout of calibration.yaml.

    Long paths of many people are written to an archive beside it, which it names.
    """
    sensors: dict[str, Any] = {}
    for name, T_root_sensor in truth.T_root_sensor.items():
        parent = {} if name == truth.root else {"parent": truth.root}
        offset = {"clock_offset": truth.clock_offsets[name]} if name in truth.clock_offsets else {}
        wrong = {"errors": dict(truth.errors[name])} if name in truth.errors else {}
        sensors[name] = {**parent, **_pose_entry(T_root_sensor), **offset, **wrong}
    captures = [
        {"trigger": b.trigger, "end": b.end, "disturbed": b.disturbed, **_pose_entry(b.T_root_board)}
        for b in truth.boards
    ]
    content: dict[str, Any] = {"format": _FORMAT, "root": truth.root, "sensors": sensors, "captures": captures}
    if truth.T_base_root is not None:
        content["base"] = _pose_entry(truth.T_base_root)
    if sum(len(person.times) for person in truth.people) > _MAX_SAMPLES:
        archive = f"{path.stem}_people.npz"
        content["people"] = archive
        _save_people(path.with_name(archive), truth.people)
    elif truth.people:
        content["people"] = [
            {**_describe_path(person), "path": _path_samples(person).tolist()} for person in truth.people
        ]
    save_yaml(path, content)


def load_truth(path: Path) -> GroundTruth:
    """Reads a truth.yaml.

    Raises:
        InputError: the file is missing or is not a truth.yaml.
    """
    content = read_yaml(path)
    try:
        if content.get("format") != _FORMAT:
            raise InputError(f"{path}: is not a truth.yaml; its format must be {_FORMAT}")
        return GroundTruth(
            content["root"],
            {name: _read_pose(entry) for name, entry in content["sensors"].items()},
            tuple(
                BoardTruth(entry["trigger"], entry["end"], _read_pose(entry), entry["disturbed"])
                for entry in content["captures"]
            ),
            {name: entry["clock_offset"] for name, entry in content["sensors"].items() if "clock_offset" in entry},
            _read_people(path, content.get("people", ())),
            {name: entry["errors"] for name, entry in content["sensors"].items() if "errors" in entry},
            _read_pose(content["base"]) if "base" in content else None,
        )
    except KeyError as error:
        raise InputError(f"{path}: the key {error.args[0]!r} is missing") from error
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: is not as simulate writes it ({' '.join(str(error).split())})") from error


def _pose_entry(T: Array) -> dict[str, list[float]]:
    return {"translation": T[:3, 3].tolist(), "rotation": so3.quaternion(T[:3, :3]).tolist()}


def _read_pose(entry: Mapping[str, Any]) -> Array:
    rotation = np.array(entry["rotation"], dtype=np.float64)
    if not (rotation.shape == (4,) and abs(math.hypot(*rotation) - 1) < _MAX_LENGTH_ERROR):
        raise ValueError(f"a rotation must be a quaternion x, y, z, w of length 1, got {entry['rotation']!s:.80}")
    return se3.from_xyz_quaternion(entry["translation"], rotation)


def _describe_path(person: PersonTruth) -> dict[str, Any]:
    """The keys of a person beside the samples of the path, which are evenly spaced."""
    interval = float(np.diff(person.times[:2]).sum().round(6))
    start = float(person.times[0]) if len(person.times) else 0.0
    return {"axes": person.axes.tolist(), "start": start, "interval": interval}


def _path_samples(person: PersonTruth) -> Array:
    """(K, 3) x, y, heading to a hundredth of a millimetre."""
    return np.column_stack([person.positions, person.headings]).round(5)


def _save_people(path: Path, people: Sequence[PersonTruth]) -> None:
    entries = [{**_describe_path(person), "samples": len(person.times)} for person in people]
    samples = np.concatenate([_path_samples(person) for person in people])
    write_archive(path, _PEOPLE_MEMBER, {"format": _PEOPLE_FORMAT, "people": entries}, {"paths": samples})


def _read_people(path: Path, given: Any) -> tuple[PersonTruth, ...]:
    """From the entries in truth.yaml, or from the archive that it names."""
    if not isinstance(given, str):
        return tuple(_read_person(entry, entry["path"]) for entry in given)
    archive = path.with_name(PurePath(given).name)
    content, arrays = read_archive(archive, _PEOPLE_MEMBER, _PEOPLE_FORMAT, _MAX_ARCHIVE_BYTES)
    ends = np.cumsum([entry["samples"] for entry in content["people"]])
    paths = np.split(arrays["paths"], ends[:-1])
    return tuple(_read_person(entry, samples) for entry, samples in zip(content["people"], paths, strict=True))


def _read_person(entry: Mapping[str, Any], path: Any) -> PersonTruth:
    samples = np.array(path, dtype=np.float64).reshape(-1, 3)
    times = entry["start"] + entry["interval"] * np.arange(len(samples))
    return PersonTruth(np.array(entry["axes"], dtype=np.float64), times, samples[:, :2], samples[:, 2])

"""truth.yaml: where the sensors of a simulated robot and the board really were."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.rig import save_yaml

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
class Truth:
    """What a calibration of a simulated recording ought to find."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor."""
    boards: tuple[BoardTruth, ...]
    """One for each capture, in order."""


def save_truth(path: Path, truth: Truth) -> None:
    """Writes a truth.yaml; its ``sensors`` have the layout of calibration.yaml."""
    sensors: dict[str, Any] = {}
    for name, T_root_sensor in truth.T_root_sensor.items():
        parent = {} if name == truth.root else {"parent": truth.root}
        sensors[name] = {**parent, **_plain(T_root_sensor)}
    captures = [
        {"trigger": b.trigger, "end": b.end, "disturbed": b.disturbed, **_plain(b.T_root_board)}
        for b in truth.boards
    ]
    save_yaml(path, {"format": _FORMAT, "root": truth.root, "sensors": sensors, "captures": captures})


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

"""Reading and writing rig.yaml, with errors that name file, key, value and what is allowed."""

import difflib
from pathlib import Path
from typing import Any

import pydantic
from pydantic import BaseModel
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from calgraph.errors import InputError
from calgraph.rig import rig as _rig
from calgraph.rig import target as _target
from calgraph.rig.rig import Rig

_PARTS: tuple[type[BaseModel], ...] = (
    Rig, _rig.Capture, _rig.CameraSpec, _rig.Lidar2dSpec, _rig.Lidar3dSpec, _rig.Intrinsics, _rig.PixelNoise,
    _rig.RangeNoise, _target.Board, _target.Tag, _target.Checkerboard, _target.Charuco, _target.AprilGrid,
    _target.People, _target.Cylinder,
)  # fmt: skip


def load_rig(path: Path) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, or has a wrong key or value.

    """
    try:
        content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: must hold the keys root, target and sensors, not {type(content).__name__}")
    try:
        return Rig.model_validate(content)
    except pydantic.ValidationError as error:
        lines = [f"{path}: {_explain(details)}" for details in _most_specific(error)]
        raise InputError("\n".join(lines)) from error


def save_yaml(path: Path, content: dict[str, Any]) -> None:
    """Writes plain values as YAML, short lists on one line."""
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 110
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(content, file)


def _most_specific(error: pydantic.ValidationError) -> list[ErrorDetails]:
    """The errors worth showing: a union reports each of its members, so keep those for the kind given."""
    details = error.errors()
    as_list_of_boards = [d for d in details if "tuple[Board, ...]" in d["loc"]]
    if len(as_list_of_boards) < len(details):
        details = (
            [d for d in details if d not in as_list_of_boards]
            if not _target_is_list(details)
            else as_list_of_boards
        )
    return details


def _target_is_list(details: list[ErrorDetails]) -> bool:
    return any(d["loc"] and d["loc"][0] == "target" and isinstance(d.get("input"), list) for d in details)


def _explain(details: ErrorDetails) -> str:
    tags = {
        "camera",
        "lidar2d",
        "lidar3d",
        "board",
        "people",
        "cylinder",
        "checkerboard",
        "charuco",
        "aprilgrid",
    }
    inner = [
        part
        for i, part in enumerate(details["loc"])
        # Discriminators and type names that pydantic adds to the path are not keys of the file.
        if not (
            isinstance(part, str) and (("[" in part) or (part in tags and i > 0 and _is_discriminator(details, i)))
        )
    ]
    key = ".".join(str(part) for part in inner) or "the file"
    if details["type"] == "extra_forbidden":
        name = str(details["loc"][-1])
        known = sorted({field for part in _PARTS for field in part.model_fields})
        close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        return f"unknown key {key}" + (f"; did you mean {close[0]!r}?" if close else "")
    message = details["msg"].removeprefix("Value error, ")
    given = "" if isinstance(details["input"], dict | list) else f", got {details['input']!r}"
    return f"{key}: {message[:1].lower()}{message[1:]}{given if given and given[5:] not in message else ''}"


def _is_discriminator(details: ErrorDetails, position: int) -> bool:
    before = details["loc"][position - 1]
    return (
        before in ("target", "pattern") or (position == 2 and details["loc"][0] == "sensors") or "[" in str(before)
    )

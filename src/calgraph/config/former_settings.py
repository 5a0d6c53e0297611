"""Settings of earlier versions that are constants now: their values are accepted, others are errors."""

import json
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from typing import Any

from calgraph.io.strict_model import invalid

# What a user can state instead, by the beginning of the former key; the longest one applies.
_REPLACEMENTS = {
    "": "the sensors' noise and uncertainty in rig.yaml state what is special about a rig",
    "baselines": "settings.published selects the papers' methods",
    "captures": "capture.mode, capture.background and capture.trigger of rig.yaml state how it was recorded",
    "captures.clock_alignment": "clock_offset of a sensor states what is known about its clock",
    "detection": "noise and uncertainty of the sensor state what its measurements are like",
    "diagnostics": "tolerance of rig.yaml states what is good",
    "estimation.intrinsics": "intrinsics or camera_info of the camera states them, so that none are estimated",
    "estimation.network": "target and uncertainty of rig.yaml state what is known about people and scanners",
    "estimation.rig": "noise and uncertainty of the sensors state what is known about them",
    "graph": "settings.published.average and start select other methods",
    "live": "settings.live has what operators set",
    "pairwise.scanners": "clock_offset and mounting of a scanner state what is known, so that it is not searched",
    "tracking": "noise of the scanner and axes of the target state what is tracked",
}


def drop_former_settings(content: Any) -> Any:
    """``content`` without former settings.

    Args:
        content: what a file has under ``settings``; it is returned as it is if it is no mapping.

    Raises:
        PydanticCustomError: a former setting has another value than the constant that it is now.
    """
    if not isinstance(content, dict) or not any(key in _former_values() for key, _ in _list_leaves(content)):
        return content
    return _drop(content, "")


@cache
def _former_values() -> dict[str, Any]:
    """Value by key, such as ``graph.max_trees``."""
    text = files("calgraph.config").joinpath("former_settings.json").read_text(encoding="utf-8")
    values: dict[str, Any] = json.loads(text)
    return values


def _list_leaves(content: dict[Any, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _list_leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _drop(content: dict[Any, Any], above: str) -> dict[Any, Any]:
    kept = {}
    for name, value in content.items():
        key = f"{above}{name}"
        if isinstance(value, dict):
            # A class whose settings are all former ones is dropped with them.
            if (inner := _drop(value, f"{key}.")) or not value:
                kept[name] = inner
        elif key not in _former_values():
            kept[name] = value
        elif value != (constant := _former_values()[key]):
            instead = _REPLACEMENTS[max((start for start in _REPLACEMENTS if key.startswith(start)), key=len)]
            fixed = "none" if constant is None else str(constant)
            raise invalid(key, f"is no setting any more and is always {fixed}, got {value!r}; {instead}")
    return kept

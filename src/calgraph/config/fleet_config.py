"""fleet.yaml: the robots of a fleet, their recordings, and when a sensor counts as moved."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from calgraph.io.quantities import DegreeLimit, LengthLimit
from calgraph.io.strict_model import StrictModel, invalid
from calgraph.io.yaml_limits import MAX_VALUES
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.sensors.kinds.stated import CONTROL_CHARACTERS

_ROBOT_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
"""Names of robots are those of folders, and parts of links."""
PathPattern = Annotated[str, Field(min_length=1, max_length=4096, pattern=rf"^[^{CONTROL_CHARACTERS}]*$")]
_MAX_ROBOTS = 10_000
"""The overview of ten times as many as were tried is still a page that opens."""
_MAX_RECORDINGS = 1_000
"""Of a robot: one a day for years."""


def _to_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Recordings = Annotated[
    tuple[PathPattern, ...], Field(min_length=1, max_length=_MAX_RECORDINGS), BeforeValidator(_to_list)
]


class RobotEntry(StrictModel):
    """What is different for one robot; ``{}`` if nothing is."""

    rig: PathPattern | None = None
    """Its rig.yaml, instead of that of the fleet."""
    recordings: Recordings | None = None
    """Its recordings, instead of those of the fleet."""
    reference: PathPattern | None = None
    """Its reference, instead of that of the fleet."""


class ChangeRules(StrictModel):
    """When a sensor counts as moved between two recordings."""

    false_alarm_probability: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Bound on the probability with which any sensor of the whole fleet is named although none has moved: that of
    each comparison of two recordings is this, divided by their number (Bonferroni). A false alarm costs a look at
    a robot, so that one in 100 runs is rare enough."""
    min_translation: LengthLimit = 0.002
    """m; smaller displacements count as moved only by their rotation. Warm aluminium of 1 m expands by 0.1 mm
    for 4 K, and brackets give by a millimetre when robots brake."""
    min_rotation: DegreeLimit = 0.1
    """Degrees; the same of rotations: 2 mm at the distance of 1 m."""
    common_variance: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Share of the variance of systematic errors (lens, range bias, print of the board) that recordings of one
    robot have in common. The rest differs: refocusing and temperature change a focal length by 0.1 % where its
    prior is 1 %, and ranges by some mm where it is 20 mm. 0 if each recording has another board and other
    sensors."""
    indistinguishable_ratio: Annotated[float, Field(ge=1)] = 100.0
    """Sensors that explain a change with a likelihood smaller than the largest by less than this factor are all
    named, as "a or b": if each is as likely to move, one alone is wrong in 1 of 100 moves."""
    max_sets: Annotated[int, Field(ge=1)] = 3000
    """Sets of sensors of one size that are all tested, in about a second; where there are more, the best smaller
    set grows by one sensor."""


class FleetConfig(StrictModel):
    """A whole fleet.yaml. Paths are relative to its folder; ``{robot}`` stands for the name of each robot."""

    rig: PathPattern | None = None
    """The rig.yaml of all robots that state no other."""
    recordings: Recordings | None = None
    """The recordings of all robots that state no others, in the order of time: paths, or patterns with ``*``,
    ``?`` and ``**`` whose matches are sorted by name. Each is one recording."""
    action: Literal["calibrate", "check"] = "calibrate"
    """``check`` compares each recording with the reference, as the command of this name does."""
    reference: PathPattern | None = None
    """Extrinsics of all robots that state no others: calibration.yaml, URDF, or transforms of tf."""
    robots: Annotated[dict[str, RobotEntry], Field(min_length=1, max_length=_MAX_ROBOTS)]
    """The robots by name."""
    changes: ChangeRules = ChangeRules()

    @model_validator(mode="after")
    def _names_are_of_folders(self) -> "FleetConfig":
        for name in self.robots:
            if not _ROBOT_NAME.fullmatch(name):
                raise invalid(
                    "robots", f"names have up to 100 letters, digits, _, - and ., and no . first, got {name!r:.60}"
                )
        return self

    @model_validator(mode="after")
    def _complete(self) -> "FleetConfig":
        needed = ["rig", "recordings", *(["reference"] if self.action == "check" else [])]
        for key in needed:
            if getattr(self, key) is None:
                missing = next((n for n, one in self.robots.items() if getattr(one, key) is None), None)
                if missing is not None:
                    raise invalid(f"robots.{missing}.{key}", f"is missing, and the fleet has no {key}")
        return self


def load_fleet(path: Path | str) -> FleetConfig:
    """Reads a fleet.yaml.

    Raises:
        InputError: the file is missing, is not YAML, is too large, or has invalid keys or values, each on one
            line.
    """
    path = Path(path)
    return validate_content(FleetConfig, read_yaml(path, MAX_VALUES), path)

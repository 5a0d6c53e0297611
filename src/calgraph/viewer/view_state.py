"""What of a calibration is looked at: when, in which colours, and which sensor is moved off its pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.result import Calibration

Coloring = Literal["camera", "height", "sensor"]
NOWHERE = (0.0,) * 6


@dataclass(frozen=True)
class Choice:
    """What is shown."""

    moment: float | None = None
    """A rig's capture, or s from the start of a network's recording; None for all at once."""
    coloring: Coloring = "sensor"
    """Of what scanners measured: as cameras see it, by height, or by who measured it."""
    moved: str = ""
    """A sensor that is moved off its pose."""
    by: tuple[float, ...] = NOWHERE
    """x, y, z, m, and roll, pitch, yaw, rad, along and about the root's fixed axes."""


def poses(calibration: Calibration, choice: Choice) -> Mapping[str, Array]:
    """``T_root_sensor`` (4, 4) of all sensors, one of them moved: it turns about its own origin."""
    found = {sensor.name: sensor.T_root_sensor for sensor in calibration.sensors}
    if choice.moved in found:
        T, shift = found[choice.moved], np.array(choice.by)
        found[choice.moved] = se3.pose(turn(*shift[3:]) @ T[:3, :3], T[:3, 3] + shift[:3])
    return found


def turn(roll: float, pitch: float, yaw: float) -> Array:
    """The rotation (3, 3) about the fixed axes x, y and z, in this order, rad."""
    Rx, Ry, Rz = so3.exp(np.diag([roll, pitch, yaw]))
    return np.asarray(Rz @ Ry @ Rx)


def up(calibration: Calibration) -> Array:
    """(3,) which way is up in the root's frame: a camera's y points down."""
    return np.array([0.0, -1.0, 0.0] if calibration[calibration.root].kind == "camera" else [0.0, 0.0, 1.0])

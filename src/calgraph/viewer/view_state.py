"""The state of the view: moment, colouring, and the displacement of a sensor from its pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.result import Calibration
from calgraph.sensors.kinds import KINDS

Coloring = Literal["camera", "height", "sensor"]
NO_DISPLACEMENT = (0.0,) * 6


@dataclass(frozen=True)
class ViewState:
    """Moment, colouring and displacement."""

    moment: float | None = None
    """A rig's capture, s from the start of a network's recording, or a part of a drive; None for all."""
    coloring: Coloring = "sensor"
    """Colours of points: from camera images, by height, or by sensor."""
    moved_sensor: str = ""
    """The sensor that is displaced from its pose; empty for none."""
    displacement: tuple[float, ...] = NO_DISPLACEMENT
    """x, y, z, m, and roll, pitch, yaw, rad, along and about the root's fixed axes."""
    corrected: bool = False
    """Whether points of scanners are without their systematic errors."""


def displaced_poses(calibration: Calibration, state: ViewState) -> Mapping[str, Array]:
    """``T_root_sensor`` (4, 4) of all sensors, one of them displaced: it rotates about its origin."""
    found = {sensor.name: sensor.T_root_sensor for sensor in calibration.sensors}
    if state.moved_sensor in found:
        T, shift = found[state.moved_sensor], np.array(state.displacement)
        found[state.moved_sensor] = se3.pose(rotation_from_rpy(*shift[3:]) @ T[:3, :3], T[:3, 3] + shift[:3])
    return found


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """The rotation (3, 3) about the fixed axes x, y and z, in this order, rad."""
    Rx, Ry, Rz = so3.exp(np.diag([roll, pitch, yaw]))
    return np.asarray(Rz @ Ry @ Rx)


def up_direction(calibration: Calibration) -> Array:
    """(3,) the upward direction in the root frame: a camera's y points down; drives and plans are level."""
    if calibration.pictures.drive_paths:
        return np.asarray(root_in_drive(calibration, 0)[2, :3])
    if calibration.pictures.floor_views:
        return calibration.pictures.T_plan_root[2, :3]
    return np.array([0.0, -1.0, 0.0] if KINDS[calibration[calibration.root].kind].optical else [0.0, 0.0, 1.0])


def root_in_drive(calibration: Calibration, part: int) -> Array:
    """``T_world_root`` (4, 4) in the middle of a part of a drive, where its sensors are shown."""
    poses = calibration.pictures.drive_paths[part].T_world_root
    return np.asarray(poses[len(poses) // 2])

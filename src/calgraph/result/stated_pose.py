"""What rig.yaml states of the poses of a network's scanners beyond what is measured: height, roll and pitch."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.result.calibration import Calibration
from calgraph.result.sensor_pose import StatedPose

# A rotation by 180° about x.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def apply_stated_poses(calibration: Calibration) -> Calibration:
    """The calibration with the stated heights, rolls and pitches in its poses, for programs that need all axes.

    The height of a scanner relative to the root is zero unless both are stated.
    """
    if not calibration.planar or not any(sensor.stated for sensor in calibration.sensors):
        return calibration
    of_root = calibration[calibration.root].stated or StatedPose()
    T_level_root = _place(np.eye(4), of_root, of_root)
    sensors = []
    for sensor in calibration.sensors:
        inverted = of_root.inverted != bool(sensor.T_root_sensor[2, 2] < 0)
        stated = replace(sensor.stated or StatedPose(), inverted=inverted)
        flips = (_FLIP if one.inverted else np.eye(4) for one in (of_root, stated))
        T_level_sensor = _place(next(flips) @ sensor.T_root_sensor @ next(flips), stated, of_root)
        sensors.append(replace(sensor, T_root_sensor=se3.inverse(T_level_root) @ T_level_sensor))
    return replace(calibration, sensors=tuple(sensors))


def _place(T_level_upright: Array, stated: StatedPose, of_root: StatedPose) -> Array:
    """``T_level_sensor`` (4, 4) from the levelled, upright frame of the scanner, at the height of the root."""
    tilt = so3.exp(np.array([0.0, stated.pitch, 0.0])) @ so3.exp(np.array([stated.roll, 0.0, 0.0]))
    T = T_level_upright @ se3.pose(tilt, np.zeros(3)) @ (_FLIP if stated.inverted else np.eye(4))
    if stated.height is not None and of_root.height is not None:
        T[2, 3] += stated.height - of_root.height
    return np.asarray(T)

"""Poses of sensors one of which is moved."""

import numpy as np
from scipy.spatial.transform import Rotation

from calgraph.result import Calibration
from calgraph.viewer.view_state import Choice, poses, turn


def test_nothing_moves_unless_it_is_moved(rig: Calibration) -> None:
    for sensor in rig.sensors:
        np.testing.assert_array_equal(poses(rig, Choice())[sensor.name], sensor.T_root_sensor)


def test_a_sensor_moves_along_the_axes_of_the_root(rig: Calibration) -> None:
    name = "camera/front *1*"
    T = poses(rig, Choice(moved=name, by=(0.1, -0.2, 0.3, 0, 0, 0)))
    np.testing.assert_allclose(T[name][:3, 3], rig[name].T_root_sensor[:3, 3] + [0.1, -0.2, 0.3], atol=1e-15)
    np.testing.assert_array_equal(T[name][:3, :3], rig[name].T_root_sensor[:3, :3])
    np.testing.assert_array_equal(T["laser"], rig["laser"].T_root_sensor)


def test_a_sensor_turns_about_its_own_origin(rig: Calibration) -> None:
    T = poses(rig, Choice(moved="laser", by=(0, 0, 0, 0.1, 0.2, 0.3)))["laser"]
    np.testing.assert_array_equal(T[:3, 3], rig["laser"].T_root_sensor[:3, 3])
    np.testing.assert_allclose(T[:3, :3], turn(0.1, 0.2, 0.3) @ rig["laser"].T_root_sensor[:3, :3], atol=1e-15)


def test_roll_pitch_and_yaw_are_about_fixed_axes() -> None:
    expected = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_matrix()
    np.testing.assert_allclose(turn(0.3, -0.5, 1.1), expected, atol=1e-14)

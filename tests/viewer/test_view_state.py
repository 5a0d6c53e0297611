"""Poses of sensors with a displacement."""

import numpy as np
from scipy.spatial.transform import Rotation

from calgraph.result import Calibration
from calgraph.viewer.view_state import ViewState, displaced_poses, rotation_from_rpy


def test_without_displacement_poses_are_unchanged(rig: Calibration) -> None:
    for sensor in rig.sensors:
        np.testing.assert_array_equal(displaced_poses(rig, ViewState())[sensor.name], sensor.T_root_sensor)


def test_a_sensor_moves_along_the_axes_of_the_root(rig: Calibration) -> None:
    name = "camera/front *1*"
    T = displaced_poses(rig, ViewState(moved_sensor=name, displacement=(0.1, -0.2, 0.3, 0, 0, 0)))
    np.testing.assert_allclose(T[name][:3, 3], rig[name].T_root_sensor[:3, 3] + [0.1, -0.2, 0.3], atol=1e-15)
    np.testing.assert_array_equal(T[name][:3, :3], rig[name].T_root_sensor[:3, :3])
    np.testing.assert_array_equal(T["laser"], rig["laser"].T_root_sensor)


def test_a_sensor_rotates_about_its_origin(rig: Calibration) -> None:
    T = displaced_poses(rig, ViewState(moved_sensor="laser", displacement=(0, 0, 0, 0.1, 0.2, 0.3)))["laser"]
    np.testing.assert_array_equal(T[:3, 3], rig["laser"].T_root_sensor[:3, 3])
    np.testing.assert_allclose(
        T[:3, :3], rotation_from_rpy(0.1, 0.2, 0.3) @ rig["laser"].T_root_sensor[:3, :3], atol=1e-15
    )


def test_roll_pitch_and_yaw_are_about_fixed_axes() -> None:
    expected = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(0.3, -0.5, 1.1), expected, atol=1e-14)

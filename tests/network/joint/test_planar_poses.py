"""Planar poses: change of the root, and conversion from a calibration."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array, se2
from calgraph.network.joint.planar_poses import extract_planar_poses
from calgraph.result import Calibration, SensorPose, Verdict
from known_networks import calibration, four_scanners


def from_c(T: Array) -> Array:
    return se2.inverse(T[2]) @ T[[2, 0, 1, 3]]


def test_a_change_of_the_root_transforms_the_covariance() -> None:
    """The expected covariance follows from finite differences."""
    poses = four_scanners(np.random.default_rng(0))
    step, J = 1e-6, np.zeros((12, 12))
    for k in range(12):
        ahead = se2.retract(poses.T_root_scanner, (step * np.eye(12)[k]).reshape(4, 3))
        J[:, k] = se2.difference(from_c(ahead), from_c(poses.T_root_scanner)).ravel() / step
    changed = poses.change_root("c")
    assert changed.names == ("c", "a", "b", "d")
    np.testing.assert_allclose(changed.T_root_scanner, from_c(poses.T_root_scanner), atol=1e-12)
    np.testing.assert_allclose(changed.covariance, J @ poses.covariance @ J.T, atol=1e-6)


def test_changing_the_root_back_restores_poses() -> None:
    poses = four_scanners(np.random.default_rng(1))
    back = poses.change_root("d").change_root("a").select(poses.names)
    np.testing.assert_allclose(back.T_root_scanner, poses.T_root_scanner, atol=1e-12)
    np.testing.assert_allclose(back.covariance, poses.covariance, atol=1e-12)


def test_planar_poses_of_a_calibration_are_restored() -> None:
    poses = four_scanners(np.random.default_rng(2))
    read = extract_planar_poses(calibration(poses))
    np.testing.assert_allclose(read.T_root_scanner, poses.T_root_scanner, atol=1e-12)
    np.testing.assert_array_equal(read.covariance, poses.covariance)


def test_a_rig_with_a_camera_is_refused() -> None:
    root = SensorPose("a", None, "a", "camera", np.eye(4), Verdict("good"))
    with pytest.raises(InputError, match=r"network of 2-D scanners"):
        extract_planar_poses(Calibration("a", (root,), np.zeros((6, 6))))

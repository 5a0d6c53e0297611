"""Poses in the plane: seen from another scanner, errors go along."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.estimation.network.planar_poses import extract_planar_poses
from calgraph.geometry import Array, se2
from calgraph.result import Calibration, SensorPose, Verdict
from known_networks import calibration, four_scanners


def from_c(T: Array) -> Array:
    return se2.inverse(T[2]) @ T[[2, 0, 1, 3]]


def test_covariance_from_another_scanner_is_that_of_moved_poses() -> None:
    """Against the numerical derivative of the change of frames."""
    known = four_scanners(np.random.default_rng(0))
    step, J = 1e-6, np.zeros((12, 12))
    for k in range(12):
        ahead = se2.retract(known.T_root_scanner, (step * np.eye(12)[k]).reshape(4, 3))
        J[:, k] = se2.difference(from_c(ahead), from_c(known.T_root_scanner)).ravel() / step
    seen = known.change_root("c")
    assert seen.names == ("c", "a", "b", "d")
    np.testing.assert_allclose(seen.T_root_scanner, from_c(known.T_root_scanner), atol=1e-12)
    np.testing.assert_allclose(seen.covariance, J @ known.covariance @ J.T, atol=1e-6)


def test_there_and_back_changes_nothing() -> None:
    known = four_scanners(np.random.default_rng(1))
    back = known.change_root("d").change_root("a").select(known.names)
    np.testing.assert_allclose(back.T_root_scanner, known.T_root_scanner, atol=1e-12)
    np.testing.assert_allclose(back.covariance, known.covariance, atol=1e-12)


def test_a_calibration_gives_back_the_poses_it_was_made_of() -> None:
    known = four_scanners(np.random.default_rng(2))
    read = extract_planar_poses(calibration(known))
    np.testing.assert_allclose(read.T_root_scanner, known.T_root_scanner, atol=1e-12)
    np.testing.assert_array_equal(read.covariance, known.covariance)


def test_a_rig_with_a_camera_is_refused() -> None:
    root = SensorPose("a", None, "a", "camera", np.eye(4), Verdict("good"))
    with pytest.raises(InputError, match=r"network of 2-D scanners"):
        extract_planar_poses(Calibration("a", (root,), np.zeros((6, 6))))

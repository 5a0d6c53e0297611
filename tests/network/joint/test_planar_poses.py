"""Planar poses: change of the root, conversion from a calibration, and priors from an earlier one."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array, se2
from calgraph.network.joint.planar_poses import NetworkPoses, build_scanner_prior, extract_planar_poses
from calgraph.network.joint.scanner_matrix import ScannerMatrix, ScannerOrder
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


def test_an_exact_pose_has_a_prior_of_10_micrometres_and_1_microradian() -> None:
    T = np.stack([np.eye(3), se2.pose(0.5, np.array([4.0, 1.0]))])
    prior = build_scanner_prior(NetworkPoses(("root", "east"), T, np.zeros((6, 6))), ("root", "east"))
    np.testing.assert_allclose(prior.information, np.diag([1e10, 1e10, 1e12]))


def test_the_prior_of_a_pose_is_the_inverse_of_its_covariance() -> None:
    """North is not in the network, south has no earlier pose."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    covariance = np.zeros((9, 9))
    covariance[3:, 3:] = A @ A.T * 1e-4
    T = np.stack([np.eye(3), se2.pose(0.5, np.array([4.0, 1.0])), se2.pose(-2.0, np.array([1.0, 6.0]))])
    poses = NetworkPoses(("root", "north", "east"), T, covariance)
    prior = build_scanner_prior(poses, ("root", "south", "east"))
    assert prior.nodes.tolist() == [2]
    np.testing.assert_array_equal(prior.T_root_scanner, T[2:])
    np.testing.assert_allclose(prior.information @ covariance[6:, 6:], np.eye(3), atol=1e-4)


def test_the_cost_of_a_prior_is_half_the_squared_mahalanobis_distance() -> None:
    """2 standard deviations of x."""
    T = np.stack([np.eye(3), se2.pose(0.5, np.array([4.0, 1.0]))])
    poses = NetworkPoses(("root", "east"), T, np.diag([0, 0, 0, 0.01, 0.02, 0.03]) ** 2)
    prior = build_scanner_prior(poses, ("root", "east"))
    moved = T.copy()
    moved[1, 0, 2] += 0.02
    H, g = ScannerMatrix.zeros(ScannerOrder.complete(2, 4)), np.zeros(8)
    assert prior.add_to_equations(moved, H, g) == pytest.approx(2.0, rel=1e-5)
    np.testing.assert_allclose(g, [0, 0, 0, 0, 200, 0, 0, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(H.diagonal[4:], [0.01**-2, 0.02**-2, 0.03**-2, 0], rtol=1e-5)


def test_a_prior_with_unknown_correlations_is_not_stronger_than_with_any() -> None:
    """Three scanners whose errors are all the same: their sum is known no better than one of them."""
    T, sigma = np.tile(np.eye(3), (4, 1, 1)), np.array([0.01, 0.02, 0.003])
    own = np.diag(np.append(np.zeros(3), np.tile(sigma**2, 3)))
    common = np.vstack([np.zeros((3, 3)), *[np.diag(sigma)] * 3])
    same = common @ common.T
    unknown = build_scanner_prior(NetworkPoses(tuple("rabc"), T, own), "rabc").information
    known = build_scanner_prior(NetworkPoses(tuple("rabc"), T, same), "rabc").information
    assert np.linalg.eigvalsh(known - unknown).min() > -1e-3 * np.linalg.eigvalsh(unknown).max()
    together = np.tile(np.eye(3), (3, 1))
    np.testing.assert_allclose(np.diag(together.T @ unknown @ together), sigma**-2, rtol=1e-3)

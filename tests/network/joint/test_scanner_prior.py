"""Priors of scanner poses from an earlier calibration."""

import numpy as np
import pytest

from calgraph.geometry import se2
from calgraph.network.joint.planar_poses import NetworkPoses, build_scanner_prior
from calgraph.network.joint.scanner_matrix import ScannerMatrix, ScannerOrder


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

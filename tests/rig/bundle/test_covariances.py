"""Covariances of bundles against dense matrices, and exact relative poses."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.rig.bundle.bundle_solver import MarginalizedViews, linearize_bundle, retract_state
from calgraph.rig.bundle.covariances import pose_covariance, view_covariance_factors
from calgraph.rig.bundle.observations import relative_poses
from dense_bundles import dense_jacobian, unbiased_scene


def test_covariance_is_the_dense_inverse() -> None:
    exact = unbiased_scene(boards=6)
    equations = linearize_bundle(exact.bundle, exact.truth)
    J = dense_jacobian(exact.bundle, exact.truth)
    expected = np.linalg.inv(J.T @ J)[:12, :12]
    found = pose_covariance(exact.bundle, exact.truth, equations)[6:, 6:]
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=1e-4)


def test_information_of_views_of_different_boards_is_the_dense_sum(rng: np.random.Generator) -> None:
    extra_of_local = np.array([[0, 1], [0, 2], [0, 1], [-1, 2]])
    local_jacobian, root = np.zeros((4, 8, 9)), rng.normal(size=(4, 8, 8))
    local_jacobian[:, :6, :6] = rng.normal(size=(4, 6, 6))
    local_jacobian[:, 6:, 6:] = extra_of_local[..., None] == np.arange(3)
    by_sensor, by_board = rng.normal(size=(2, 4, 6, 6))
    views = MarginalizedViews(root @ root.swapaxes(1, 2), np.zeros((4, 8)), local_jacobian, by_sensor, by_board)
    J = views.J_sensor
    expected = sum(J[v].T @ views.information[v] @ J[v] for v in range(4))
    found = views.sum_information(J, first_of_kind=np.array([0, 1, 3]), kind=np.array([0, 1, 0, 2]))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_the_root_has_no_covariance() -> None:
    exact = unbiased_scene()
    spread = pose_covariance(exact.bundle, exact.truth, linearize_bundle(exact.bundle, exact.truth))
    np.testing.assert_array_equal(spread[:6], np.zeros((6, len(spread))))


def test_covariance_where_views_measure_is_the_dense_one() -> None:
    exact = unbiased_scene(boards=4)
    factors = view_covariance_factors(exact.bundle, linearize_bundle(exact.bundle, exact.truth))[1]
    factor = factors.multiply(np.eye(6)[None])[2]
    J = dense_jacobian(exact.bundle, exact.truth)
    everything = np.linalg.inv(J.T @ J)
    T_root_camera, T_root_board = exact.truth.T_root_sensor[1], exact.truth.T_root_board[2]

    def before(step: Array) -> Array:
        after = retract_state(exact.bundle, exact.truth, step[:12], step[12:].reshape(-1, 6))
        T = relative_poses(after.T_root_sensor[1], after.T_root_board[2])
        return se3.difference(T, relative_poses(T_root_camera, T_root_board))

    steps = 1e-6 * np.eye(len(everything))
    by_all = np.stack([(before(s) - before(-s)) / 2e-6 for s in steps], axis=-1)
    expected = by_all @ everything @ by_all.T
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        factor @ factor.T / np.outer(size, size), expected / np.outer(size, size), atol=1e-3
    )


def test_relative_poses_on_one_body_have_no_covariance() -> None:
    exact = unbiased_scene()
    bundle = replace(exact.bundle, body=np.array([0, 1, 1]))
    spread = pose_covariance(bundle, exact.truth, linearize_bundle(bundle, exact.truth))[6:, 6:]
    apart = se3.relative_covariance(exact.truth.T_root_sensor[1], exact.truth.T_root_sensor[2], spread)
    assert np.abs(apart).max() < 1e-9 * np.abs(spread).max()


def test_a_body_is_estimated_from_the_views_of_all_its_sensors() -> None:
    """The laser's views add information on the camera, and conversely."""
    exact = unbiased_scene()
    alone = pose_covariance(exact.bundle, exact.truth, linearize_bundle(exact.bundle, exact.truth))[6:12, 6:12]
    bundle = replace(exact.bundle, body=np.array([0, 1, 1]))
    together = pose_covariance(bundle, exact.truth, linearize_bundle(bundle, exact.truth))[6:12, 6:12]
    assert np.linalg.eigvalsh(alone - together).min() > 0

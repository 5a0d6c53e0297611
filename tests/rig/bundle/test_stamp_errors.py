"""Errors of the stamps of a moving board's views: their covariance, and its estimate."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import Scene, remeasured, scene
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.bundle_solver import Bundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.normal_equations import BiasVariances, accumulate
from calgraph.rig.bundle.observations import relative_poses, velocity_along_sensor
from calgraph.rig.bundle.settling import settle_variances

SPEED = 0.5


def moving(exact: Scene, rng: np.random.Generator) -> Bundle:
    """The scene's bundle, with boards that move in random directions."""
    views = []
    for of_sensor in exact.bundle.views:
        linear = rng.normal(size=(len(of_sensor.board), 3))
        linear *= SPEED / np.linalg.norm(linear, axis=1, keepdims=True)
        views.append(replace(of_sensor, twist=np.concatenate([linear, np.zeros_like(linear)], axis=1)))
    return replace(exact.bundle, views=tuple(views))


def late(exact: Scene, bundle: Bundle, stddev: float, rng: np.random.Generator) -> Bundle:
    """The bundle measured with errors of the stamps."""
    views = []
    for s, of_sensor in enumerate(bundle.views):
        T = relative_poses(exact.truth.T_root_sensor[s], exact.truth.T_root_board[of_sensor.board])
        velocity = velocity_along_sensor(of_sensor.twist, T)
        assert velocity is not None
        error = stddev * rng.normal(size=(len(T), 1))
        views.append(remeasured(of_sensor, se3.retract(T, error * velocity), rng, 1.0))
    return replace(bundle, views=tuple(views))


def test_a_twist_moves_every_point_of_the_board() -> None:
    T = scene().truth.T_root_board[:3]
    twist = np.random.default_rng(0).normal(size=(3, 6))
    velocity = velocity_along_sensor(twist, T)
    assert velocity is not None
    np.testing.assert_allclose(velocity[:, :3], twist[:, :3] + np.cross(twist[:, 3:], T[:, :3, 3]))
    np.testing.assert_array_equal(velocity[:, 3:], twist[:, 3:])


@pytest.mark.parametrize("sensor", [0, 1])
def test_the_information_of_a_view_is_that_with_a_common_error_of_its_stamp(sensor: int) -> None:
    """Against the inverse of the dense covariance of all residuals of one view."""
    exact, rng = scene(boards=4), np.random.default_rng(1)
    views = moving(exact, rng).views[sensor]
    T = relative_poses(exact.truth.T_root_sensor[sensor], exact.truth.T_root_board[views.board])
    residuals = views.linearize(T, np.zeros(0))
    variance = BiasVariances(np.zeros(6), np.zeros(()), np.array(0.01**2))
    information, _, _ = accumulate(residuals, views.start, 1e9).marginalize_bias(variance)
    velocity = residuals.velocity
    assert velocity is not None
    for v, first in enumerate(views.start):
        end = views.start[v + 1] if v + 1 < len(views.start) else len(residuals.residual)
        J: Array = residuals.jacobian[first:end].reshape(-1, residuals.jacobian.shape[-1])
        along = J @ residuals.local_jacobian[v, :, :6] @ velocity[v]
        W = np.linalg.inv(np.eye(len(J)) + 0.01**2 * np.outer(along, along))
        np.testing.assert_allclose(information[v], J.T @ W @ J, rtol=1e-6, atol=1e-3)


def test_the_error_of_stamps_is_estimated() -> None:
    """10 ms at 0.5 m/s are 5 mm. With fewer boards, the view bias takes a part of it."""
    exact = scene(boards=150).without_bias()
    found = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        bundle = late(exact, moving(exact, rng), 0.010, rng)
        start = np.zeros((3, 4))
        start[:, :2], start[:, 3] = 1e-6, 0.005**2
        bundle = replace(bundle, bias_variance=start)
        settled, _, _ = settle_variances(bundle, minimize_bundle(bundle, exact.truth), 20)
        found.append(np.sqrt(settled.bias_variance[:, 3]))
    assert np.mean(found) == pytest.approx(0.010, rel=0.15)


def test_a_board_at_rest_has_no_error_of_stamps() -> None:
    bundle = scene().bundle
    assert all(3 not in bundle.bias_components(k) for k in range(3))


def test_covariances_hold_with_errors_of_stamps() -> None:
    exact = scene(boards=25).without_bias()
    squared = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        bundle = late(exact, moving(exact, rng), 0.010, rng)
        bias = np.zeros((3, 4))
        bias[:, 3] = 0.010**2
        bundle = replace(bundle, bias_variance=bias)
        solution = minimize_bundle(bundle, exact.truth)
        e = se3.difference(solution.state.T_root_sensor[1:], exact.truth.T_root_sensor[1:])
        P = pose_covariance(bundle, solution.state, solution.equations)
        squared += [
            e[i] @ np.linalg.solve(P[6 * i + 6 : 6 * i + 12, 6 * i + 6 : 6 * i + 12], e[i]) / 6 for i in (0, 1)
        ]
    assert 0.7 < np.mean(squared) < 1.35

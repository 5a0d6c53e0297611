"""The filter and the smoother, against hand-computed answers and one dense least squares over all states."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.tracking.filtering import (
    Gaussian,
    constant_velocity,
    initial_state,
    mahalanobis_distance,
    predict,
    smooth_tracks,
    update,
)


def test_a_prediction_of_one_second_by_hand() -> None:
    state = Gaussian(np.array([1.0, 2.0, 3.0, -1.0]), np.diag([0.1, 0.2, 0.5, 0.5]))
    ahead = predict(state, constant_velocity(np.array(1.0), 0.6))
    np.testing.assert_allclose(ahead.mean, [4, 1, 3, -1])
    # P_x + t² P_v + q t³/3; the covariance of x and vx is t P_v + q t²/2; P_v + q t.
    np.testing.assert_allclose(np.diag(ahead.covariance), [0.1 + 0.5 + 0.2, 0.2 + 0.5 + 0.2, 1.1, 1.1])
    assert ahead.covariance[0, 2] == pytest.approx(0.5 + 0.3)


def test_an_update_by_hand() -> None:
    state = Gaussian(np.zeros(4), np.diag([1.0, 1.0, 4.0, 4.0]))
    after = update(state, np.array([2.0, 0.0]), np.diag([1.0, 3.0]))
    np.testing.assert_allclose(after.mean, [1.0, 0, 0, 0])
    np.testing.assert_allclose(np.diag(after.covariance), [0.5, 0.75, 4, 4])


def test_the_distance_counts_prediction_and_measurement() -> None:
    squared, determinant = mahalanobis_distance(
        initial_state(np.zeros(2), np.eye(2), 1.5), np.array([3.0, 0.0]), 2 * np.eye(2)
    )
    assert squared == pytest.approx(3.0)
    assert determinant == pytest.approx(9.0)


def solve_densely(times: Array, z: Array, R: Array, acceleration_density: float) -> tuple[Array, Array]:
    """All states (T, 4) by one dense least squares, and their covariances (T, 4, 4)."""
    count = len(times)
    H, g = np.zeros((4 * count, 4 * count)), np.zeros(4 * count)
    H[2:4, 2:4] += np.eye(2) / 1.5**2
    for k in range(count):
        if np.isfinite(z[k]).all():
            W = np.linalg.inv(R[k])
            H[4 * k : 4 * k + 2, 4 * k : 4 * k + 2] += W
            g[4 * k : 4 * k + 2] += W @ z[k]
    for k in range(count - 1):
        dt = times[k + 1] - times[k]
        block = acceleration_density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        W = np.kron(np.linalg.inv(block), np.eye(2))
        J = np.hstack([-np.kron([[1, dt], [0, 1]], np.eye(2)), np.eye(4)])
        H[4 * k : 4 * k + 8, 4 * k : 4 * k + 8] += J.T @ W @ J
    covariance = np.linalg.inv(H)
    blocks = np.stack([covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(count)])
    return (covariance @ g).reshape(count, 4), blocks


@pytest.fixture
def walk(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Irregular times, measured centres with a gap, and their covariances."""
    times = np.cumsum(rng.uniform(0.03, 0.2, 30))
    z = np.stack([times, np.sin(times)], axis=1) + rng.normal(0, 0.05, (30, 2))
    z[12:15] = np.nan
    A = rng.normal(0, 0.05, (30, 2, 2))
    return times, z, A @ np.swapaxes(A, 1, 2) + 0.02**2 * np.eye(2)


def test_smoothed_states_are_the_dense_least_squares(walk: tuple[Array, Array, Array]) -> None:
    smoothed, _ = smooth_tracks(*walk, acceleration_density=0.5, gate=np.inf, speed_sigma=1.5)
    np.testing.assert_allclose(smoothed.mean, solve_densely(*walk, 0.5)[0], atol=1e-8)


def test_smoothed_covariances_are_those_of_the_dense_least_squares(walk: tuple[Array, Array, Array]) -> None:
    smoothed, _ = smooth_tracks(*walk, acceleration_density=0.5, gate=np.inf, speed_sigma=1.5)
    np.testing.assert_allclose(smoothed.covariance, solve_densely(*walk, 0.5)[1], atol=1e-8)


def test_padding_changes_nothing(walk: tuple[Array, Array, Array]) -> None:
    times, z, R = walk
    alone, _ = smooth_tracks(times, z, R, 0.5, np.inf, 1.5)
    padded, _ = smooth_tracks(
        np.stack([np.append(times, [times[-1]] * 5)] * 2),
        np.stack([np.concatenate([z, np.full((5, 2), np.nan)])] * 2),
        np.stack([np.concatenate([R, np.full((5, 2, 2), np.nan)])] * 2),
        0.5,
        np.inf,
        1.5,
    )
    np.testing.assert_allclose(padded.mean[1, :30], alone.mean, atol=1e-9)


def test_a_measurement_outside_the_gate_is_rejected(walk: tuple[Array, Array, Array]) -> None:
    times, z, R = walk
    z[20] += 5.0
    smoothed, used = smooth_tracks(times, z, R, 0.5, 13.8, 1.5)
    assert not used[20]
    assert np.linalg.norm(smoothed.mean[20, :2] - [times[20], np.sin(times[20])]) < 0.1

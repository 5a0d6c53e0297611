"""Kalman filter and Rauch–Tung–Striebel smoother of a constant-velocity model with white acceleration.

The state is (x, y, vx, vy). The measurement is a centre with its covariance, so the model is linear. All functions
broadcast over leading axes: many tracks are filtered in one batch.

Source: Särkkä, "Bayesian filtering and smoothing", 2013, sections 4.3 and 8.2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, invert_2x2


@dataclass(frozen=True, eq=False)
class Gaussian:
    """State estimates."""

    mean: Array
    """(..., 4) x, y (m), vx, vy (m/s)."""
    covariance: Array
    """(..., 4, 4)."""


def initial_state(z: Array, R: Array, speed_sigma: float) -> Gaussian:
    """The state after one measured centre (..., 2) with covariance (..., 2, 2) and a velocity sigma, m/s."""
    mean = np.concatenate([z, np.zeros_like(z)], axis=-1)
    covariance = np.zeros((*z.shape[:-1], 4, 4))
    covariance[..., :2, :2] = R
    covariance[..., [2, 3], [2, 3]] = speed_sigma**2
    return Gaussian(mean, covariance)


@dataclass(frozen=True, eq=False)
class Transition:
    """Transition of states over intervals of time."""

    F: Array
    """(..., 4, 4) transition matrix."""
    Q: Array
    """(..., 4, 4) process noise."""

    def at(self, index: int) -> "Transition":
        """The interval with this index along the last of the leading axes."""
        return Transition(self.F[..., index, :, :], self.Q[..., index, :, :])


def constant_velocity(dt: Array, acceleration_density: float) -> Transition:
    """Transition at constant velocity with white acceleration.

    Args:
        dt: (...,) time passed, s.
        acceleration_density: spectral density of the acceleration, m²/s³.
    """
    F = np.zeros((*dt.shape, 4, 4))
    F[..., range(4), range(4)] = 1.0
    F[..., [0, 1], [2, 3]] = dt[..., None]
    Q = np.zeros((*dt.shape, 4, 4))
    Q[..., [0, 1], [0, 1]] = (dt**3 / 3)[..., None]
    Q[..., [0, 1, 2, 3], [2, 3, 0, 1]] = (dt**2 / 2)[..., None]
    Q[..., [2, 3], [2, 3]] = dt[..., None]
    return Transition(F, acceleration_density * Q)


def predict(state: Gaussian, step: Transition) -> Gaussian:
    """The state after an interval of time."""
    mean = (step.F @ state.mean[..., None])[..., 0]
    return Gaussian(mean, step.F @ state.covariance @ np.swapaxes(step.F, -1, -2) + step.Q)


def update(state: Gaussian, z: Array, R: Array) -> Gaussian:
    """The state after measuring the centre ``z`` (..., 2) with covariance ``R`` (..., 2, 2)."""
    P = state.covariance
    gain = P[..., :2] @ invert_2x2(P[..., :2, :2] + R)
    mean = state.mean + (gain @ (z - state.mean[..., :2])[..., None])[..., 0]
    return Gaussian(mean, P - gain @ P[..., :2, :])


def mahalanobis_distance(state: Gaussian, z: Array, R: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (...,) of centres from predictions, and determinants (...,) of their S."""
    S = state.covariance[..., :2, :2] + R
    off = z - state.mean[..., :2]
    x, y, a, b, d = off[..., 0], off[..., 1], S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    determinant = a * d - b * b
    return (d * x * x - 2 * b * x * y + a * y * y) / determinant, determinant


def smooth_tracks(
    times: Array, z: Array, R: Array, acceleration_density: float, gate: float, speed_sigma: float
) -> tuple[Gaussian, NDArray[np.bool_]]:
    """Filters forward and smooths backward many tracks of equal length.

    Args:
        times: (..., T) of the measurements, ascending, s; times may repeat.
        z: (..., T, 2) measured centres, m; NaN where there is none.
        R: (..., T, 2, 2) their covariances, m².
        acceleration_density: spectral density of the acceleration, m²/s³.
        gate: measurements with a larger squared Mahalanobis distance from their prediction are rejected.
        speed_sigma: prior standard deviation of the velocity along each axis, m/s.

    Returns:
        The smoothed states (..., T), and a mask (..., T) of the measurements that were used.
    """
    steps = times.shape[-1]
    measured = np.asarray(np.isfinite(z).all(axis=-1))
    z = np.where(measured[..., None], z, 0.0)
    R = np.where(measured[..., None, None], R, np.eye(2))
    used = measured.copy()
    filtered, predicted = [initial_state(z[..., 0, :], R[..., 0, :, :], speed_sigma)], []
    transitions = constant_velocity(np.diff(times, axis=-1), acceleration_density)
    for k in range(1, steps):
        prediction = predict(filtered[-1], transitions.at(k - 1))
        updated = update(prediction, z[..., k, :], R[..., k, :, :])
        used[..., k] &= mahalanobis_distance(prediction, z[..., k, :], R[..., k, :, :])[0] <= gate
        predicted.append(prediction)
        filtered.append(_select(used[..., k], updated, prediction))
    smoothed = [filtered[-1]]
    for k in range(steps - 2, -1, -1):
        smoothed.append(_smooth_step(filtered[k], predicted[k], smoothed[-1], transitions.at(k).F))
    smoothed.reverse()
    mean = np.stack([s.mean for s in smoothed], axis=-2)
    return Gaussian(mean, np.stack([s.covariance for s in smoothed], axis=-3)), used


def _smooth_step(here: Gaussian, ahead: Gaussian, later: Gaussian, F: Array) -> Gaussian:
    """One backward step of the smoother (Särkkä, eq. 8.6)."""
    PF = here.covariance @ np.swapaxes(F, -1, -2)
    gain = np.swapaxes(np.linalg.solve(ahead.covariance, np.swapaxes(PF, -1, -2)), -1, -2)
    mean = here.mean + (gain @ (later.mean - ahead.mean)[..., None])[..., 0]
    P = here.covariance + gain @ (later.covariance - ahead.covariance) @ np.swapaxes(gain, -1, -2)
    return Gaussian(mean, (P + np.swapaxes(P, -1, -2)) / 2)


def _select(which: NDArray[np.bool_], a: Gaussian, b: Gaussian) -> Gaussian:
    mean = np.where(which[..., None], a.mean, b.mean)
    return Gaussian(mean, np.where(which[..., None, None], a.covariance, b.covariance))

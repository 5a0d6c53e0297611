"""The pose between two scanners that fits everything they saw moving at the same time, near a first guess.

Two scanners see different sides of a person, with clocks that differ by some milliseconds. Both shift all of a
scanner's positions in the same way, towards the scanner and along the walk, so that they do not average out.
They are unknowns of the fit with a prior, and what the data leave open of them is part of the pose's covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import SimultaneousPairs

ASSOCIATION_GATE = 9.21
"""Squared Mahalanobis distance up to which two positions agree: χ² with two degrees of freedom, 99 %."""
# Standard deviation of what no covariance of a track knows (m), at first and at least.
_MAX_MODEL_ERROR = 0.15
_MIN_MODEL_ERROR = 0.005
DEPTH_STDDEV = 0.03
"""Prior standard deviation of the distance from the centre that tracks show to the object's true one, m."""
# Prior standard deviation of the clocks' difference, s.
_CLOCK_STDDEV = 0.01
# What does not average out however long people walk: the sides and the gait that they show to either scanner, m.
_SYSTEMATIC_STDDEV = 0.008
# Squared Mahalanobis distance at which the Cauchy loss halves a pair's weight.
_CAUCHY_SCALE2 = 6.0
# Fewer pairs than these fit many a pose.
_MIN_PAIRS = 4
# Gauss-Newton steps with associations made anew.
_ITERATIONS = 6
# Residuals farther apart than so many steps are independent; nearer than so many ticks they are not, as people
# show another side every half second. A few seconds of residuals alone would understate that.
_MAX_LAG = 100
_MIN_CORRELATION_TIME = 5.0


@dataclass(frozen=True, eq=False)
class TrackRegistration:
    """A pose with all that agrees with it."""

    T_a_b: Array
    """(3, 3)."""
    nuisance: Array
    """(3,) s that b's clock is ahead, and m that centres lie beyond those that a's and that b's tracks show."""
    pairs: NDArray[np.intp]
    """(P,) which of the meetings agree: each the other's nearest at its tick."""
    model_error: float
    """Standard deviation of the pairs' distances beyond what the tracks' covariances explain, m."""


def register_tracks(
    T_a_b: Array,
    candidates: SimultaneousPairs,
    *,
    depth_stddev: float = DEPTH_STDDEV,
    steps: int = _ITERATIONS,
    model_error: float = _MAX_MODEL_ERROR,
) -> TrackRegistration | None:
    """Fits the pose to all simultaneous observations that agree with it, associated anew at every step.

    Args:
        T_a_b: (3, 3) first guess.
        candidates: all simultaneous observations.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m.
        steps: how often they are associated anew.
        model_error: standard deviation of the distance between both scanners' centres of one object, m.

    Returns:
        The agreement, or None if fewer than four observations agree with the first guess.
    """
    nuisance = np.zeros(3)
    for _ in range(steps):
        pairs, d2 = _associate(T_a_b, nuisance, candidates, model_error)
        if len(pairs) < _MIN_PAIRS:
            return None
        r, J, S = _linearize(T_a_b, nuisance, candidates, pairs)
        W = _invert_symmetric(S + model_error**2 * np.eye(2)) / (1 + d2 / _CAUCHY_SCALE2)[:, None, None]
        H, g = _build_normal_equations(r, J, W, nuisance, depth_stddev)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        T_a_b = se2.retract(T_a_b, step[:3])
        nuisance = nuisance + step[3:]
        model_error = _estimate_model_error(r + J @ step, S)
    pairs, _ = _associate(T_a_b, nuisance, candidates, model_error)
    return TrackRegistration(T_a_b, nuisance, pairs, model_error) if len(pairs) >= _MIN_PAIRS else None


def compute_pose_costs(
    T_a_b: Array, candidates: SimultaneousPairs, model_error: float = _MAX_MODEL_ERROR
) -> Array:
    """Truncated squared distances to the nearest, in units of the gate, mean over all that a saw: (K,) of poses.

    Covariances count by their mean over all directions, for speed.
    """
    x_a, y_a = candidates.x_a.T
    x_b, y_b = candidates.x_b.T
    scale = 1 / (ASSOCIATION_GATE * (candidates.variance + model_error**2))
    out = np.empty(len(T_a_b))
    for k, T in enumerate(T_a_b):  # what one pose needs fits into the processor's cache
        x = T[0, 0] * x_b + T[0, 1] * y_b + (T[0, 2] - x_a)
        y = T[1, 0] * x_b + T[1, 1] * y_b + (T[1, 2] - y_a)
        d2 = (x * x + y * y) * scale
        out[k] = np.minimum(np.minimum.reduceat(d2, candidates.starts_a), 1).mean()
    return out


def _associate(
    T_a_b: Array, nuisance: Array, candidates: SimultaneousPairs, model_error: float
) -> tuple[NDArray[np.intp], Array]:
    """The meetings (P,) of mutual nearest neighbours within the gate, and their squared Mahalanobis distances."""
    differences = _compute_differences(T_a_b, nuisance, candidates)
    rough = np.sum(differences**2, axis=1) / (candidates.variance + model_error**2)
    # The exact covariance matters for the gate alone; who is nearest is clear without it.
    near = np.flatnonzero(rough < 4 * ASSOCIATION_GATE)
    if not len(near):
        return near, np.zeros(0)
    near = near[candidates.are_mutual_nearest(near, rough[near])]
    r, _, S = _linearize(T_a_b, nuisance, candidates, near)
    d2 = _mahalanobis2(r, _invert_symmetric(S + model_error**2 * np.eye(2)))
    return near[d2 < ASSOCIATION_GATE], d2[d2 < ASSOCIATION_GATE]


def _linearize(
    T: Array, nuisance: Array, candidates: SimultaneousPairs, pairs: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Differences (P, 2) of positions in a's frame, Jacobians (P, 2, 6) by pose, clock, depths, covariances."""
    R = T[:2, :2]
    rotated = candidates.x_b[pairs] @ R.T
    J = np.zeros((len(pairs), 2, 6))
    J[:, 0, 0] = J[:, 1, 1] = 1
    J[:, 0, 2], J[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
    J[:, :, 3], J[:, :, 4], J[:, :, 5] = (
        candidates.v_b[pairs] @ R.T,
        -candidates.ray_a[pairs],
        candidates.ray_b[pairs] @ R.T,
    )
    S = (
        candidates.a.covariances[candidates.row_a[pairs]]
        + R @ candidates.b.covariances[candidates.row_b[pairs]] @ R.T
    )
    return _compute_differences(T, nuisance, candidates, pairs), J, S


def _compute_differences(
    T: Array, nuisance: Array, candidates: SimultaneousPairs, pairs: NDArray[np.intp] | slice = slice(None)
) -> Array:
    """(P, 2) from what a saw to what b saw, in a's frame, clocks and depths put right."""
    clock_offset, depth_a, depth_b = nuisance
    corrected_a = candidates.x_a[pairs] + depth_a * candidates.ray_a[pairs]
    corrected_b = candidates.x_b[pairs] + clock_offset * candidates.v_b[pairs] + depth_b * candidates.ray_b[pairs]
    return np.asarray(se2.apply(T, corrected_b) - corrected_a)


def _build_normal_equations(
    r: Array, J: Array, W: Array, nuisance: Array, depth_stddev: float
) -> tuple[Array, Array]:
    prior = np.array([0, 0, 0, _CLOCK_STDDEV**-2, depth_stddev**-2, depth_stddev**-2])
    J, WJ = J.reshape(-1, 6), (W @ J).reshape(-1, 6)
    H = J.T @ WJ + np.diag(prior)
    g = WJ.T @ r.ravel() + prior * np.concatenate([np.zeros(3), nuisance])
    # A hair of damping: observations of somebody who stands still say nothing of the angle.
    return H + 1e-6 * np.eye(6), g


def _estimate_model_error(r: Array, S: Array) -> float:
    """The standard deviation (m) that the residuals have beyond their covariances, by their median."""
    observed_variance = (
        float(np.median(np.sum(r**2, axis=1))) / 1.386
    )  # the median of χ² with two degrees of freedom
    expected_variance = float(np.mean(np.trace(S, axis1=1, axis2=2))) / 2
    return float(
        np.clip(np.sqrt(max(observed_variance - expected_variance, 0.0)), _MIN_MODEL_ERROR, _MAX_MODEL_ERROR)
    )


def compute_registration_information(
    fit: TrackRegistration, candidates: SimultaneousPairs, depth_stddev: float = DEPTH_STDDEV
) -> Array:
    """(3, 3) inverse covariance of the pose's error in the fixed axes of a, with clock and depths unknown.

    Smoothed positions err for seconds in the same direction: their number counts divided by the time over
    which residuals stay correlated, in ticks.
    """
    pairs = fit.pairs
    r, J, S = _linearize(fit.T_a_b, fit.nuisance, candidates, pairs)
    W = _invert_symmetric(S + fit.model_error**2 * np.eye(2))
    d2 = _mahalanobis2(r, W)
    whitened = np.einsum("pij,pj->pi", np.swapaxes(np.linalg.cholesky(W), 1, 2), r)
    trajectories = (
        candidates.a.trajectory[candidates.row_a[pairs]] * (candidates.b.trajectory.max() + 1)
        + candidates.b.trajectory[candidates.row_b[pairs]]
    )
    ticks = candidates.a.tick[candidates.row_a[pairs]]
    correlation = max(estimate_correlation_time(whitened, trajectories, ticks), _MIN_CORRELATION_TIME)
    degrees_of_freedom = max(2 * len(pairs) / correlation - 6, 1.0)
    variance_factor = max(float(np.sum(d2)) / correlation / degrees_of_freedom, 0.1)
    H, _ = _build_normal_equations(r, J, W / (variance_factor * correlation), fit.nuisance, depth_stddev)
    random_covariance = np.linalg.inv(H)[:3, :3]
    return np.asarray(
        np.linalg.inv(random_covariance + _systematic_covariance(fit.T_a_b, candidates.x_a[pairs])),
        dtype=np.float64,
    )


def _systematic_covariance(T_a_b: Array, x_a: Array) -> Array:
    """(3, 3) covariance of the pose for what all positions (P, 2) err alike, and differently at their two ends."""
    center = x_a.mean(axis=0)
    extent = np.sqrt(np.mean(np.sum((x_a - center) ** 2, axis=1)))
    return rigid_motion_covariance(T_a_b, center, _SYSTEMATIC_STDDEV, _SYSTEMATIC_STDDEV / max(float(extent), 0.1))


def rigid_motion_covariance(T_a_b: Array, center: Array, shift: float, turn: float) -> Array:
    """(3, 3) covariance of a pose shifted (m) along either axis and turned (rad) about a center (2,) of a."""
    lever = center - T_a_b[:2, 2]
    G = np.eye(3)
    G[:2, 2] = lever[1], -lever[0]
    return np.asarray(G @ np.diag(np.array([shift, shift, turn]) ** 2) @ G.T)


def estimate_correlation_time(r: Array, series: NDArray[np.intp], ticks: NDArray[np.intp]) -> float:
    """How many successive residuals count as one independent: the integrated autocorrelation, >= 1.

    Args:
        r: (P, k) residuals of mean 0.
        series: (P,) which of them belong together.
        ticks: (P,) their times, in steps.

    Source: Geyer, "Practical Markov chain Monte Carlo", 1992: the sum ends where pairs of terms fall below 0.
    """
    order = np.lexsort((ticks, series))
    r, key = r[order], series[order] * (int(ticks.max()) + 2 * _MAX_LAG) + ticks[order] - int(ticks.min())
    power = float(np.sum(r**2)) / max(len(r), 1)
    total, previous = 1.0, 0.0
    step = int(np.min(np.diff(np.unique(ticks)), initial=_MAX_LAG))
    for lag in range(1, _MAX_LAG):
        found = np.searchsorted(key, key + lag * step)
        pairs = np.flatnonzero(key[np.minimum(found, len(key) - 1)] == key + lag * step)
        if len(pairs) < 0.1 * len(r):
            break
        term = float(np.sum(r[pairs] * r[found[pairs]])) / len(pairs) / max(power, 1e-12)
        if lag % 2 == 0 and term + previous <= 0:
            break
        total += 2 * term
        previous = term
    return max(total, 1.0)


def _mahalanobis2(r: Array, W: Array) -> Array:
    x, y = r.T
    return np.asarray(W[:, 0, 0] * x * x + 2 * W[:, 0, 1] * x * y + W[:, 1, 1] * y * y)


def _invert_symmetric(S: Array) -> Array:
    """Inverses of symmetric (P, 2, 2), five times as fast as by a general decomposition."""
    W = np.empty_like(S)
    W[:, 0, 0], W[:, 1, 1] = S[:, 1, 1], S[:, 0, 0]
    W[:, 0, 1] = W[:, 1, 0] = -S[:, 0, 1]
    return np.asarray(W / (S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2)[:, None, None])

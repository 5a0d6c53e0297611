"""Registration of the simultaneous tracks of two scanners, near an initial pose.

Two scanners measure different sides of a person, with clocks that differ by some milliseconds. Both effects shift
all positions of a scanner in the same way, towards the scanner and along the path, so that they do not average
out. They are unknowns of the fit with a prior, and their uncertainty is part of the pose's covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, invert_2x2, se2
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, to_ticks
from calgraph.network.tracking.smoothing import CHI2_MEDIAN

# Information (1/m², 1/rad²) that is added to that of a pose: the angle is unobservable from an object at rest.
_RIDGE = 1e-6
# Least extent of positions, m, by which an error of theirs is divided: keeps the quotient finite.
_MIN_EXTENT = 0.1


@dataclass(frozen=True)
class NuisancePrior:
    """Prior of clock offset and depths."""

    clock_sigma: float
    """Standard deviation of the clock offset of two scanners, s."""
    depth_sigma: float
    """Standard deviation of the distance from tracked to true centres along the beam, m."""
    clock_mean: float = 0.0
    """Mean of the clock offset of b minus a, s: not 0 where b's samples were shifted in time."""

    @property
    def mean(self) -> Array:
        """(6,) of pose, clock offset and depths."""
        return np.array([0.0, 0.0, 0.0, self.clock_mean, 0.0, 0.0])

    @property
    def information(self) -> Array:
        """(6,) of pose, clock offset and depths; none of the pose."""
        return np.append(np.zeros(3), [self.clock_sigma**-2, self.depth_sigma**-2, self.depth_sigma**-2])


@dataclass(frozen=True, eq=False)
class TrackRegistration:
    """A pose with the matches that determine it."""

    T_a_b: Array
    """(3, 3)."""
    nuisance: Array
    """(3,) clock offset of b minus a, s, and depth of true beyond tracked centres of a and of b, m."""
    matches: NDArray[np.intp]
    """(P,) rows of the simultaneous pairs that match: mutual nearest neighbours at their tick."""
    model_error: float
    """Standard deviation of the matches' distances beyond the tracks' covariances, m."""


# Gauss–Newton steps of each stage, each with new matches: proposals are near enough for matches to settle.
_STEPS = 3
# Squared Mahalanobis distance up to which positions match: chi-squared, two degrees of freedom, 99 %.
GATE = 9.21
# Minimum number of matches of a registration: eight coordinates for six unknowns.
_MIN_MATCHES = 4
# Squared Mahalanobis distance at which the Cauchy loss halves a weight: chi-squared, 95 %.
_CAUCHY_SCALE2 = 6.0


def register_tracks(
    T_a_b: Array, pairs: SimultaneousPairs, model_error: float, prior: NuisancePrior
) -> TrackRegistration | None:
    """Fits pose, clock offset and depths to the matches of simultaneous pairs, with new matches at every step.

    Args:
        T_a_b: (3, 3) initial pose.
        pairs: all simultaneous pairs.
        model_error: initial standard deviation of the distance between both scanners' centres of one object, m.
        prior: of clock offset and depths.

    Returns:
        The registration, or None if there are too few matches.
    """
    nuisance = np.zeros(3)
    for _ in range(_STEPS):
        matches, d2 = _associate(T_a_b, nuisance, pairs, model_error)
        if len(matches) < _MIN_MATCHES:
            return None
        r, J, S = _linearize(T_a_b, nuisance, pairs, matches)
        W = invert_2x2(S + model_error**2 * np.eye(2)) / (1 + d2 / _CAUCHY_SCALE2)[:, None, None]
        H, g = _build_normal_equations(r, J, W, nuisance, prior)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        T_a_b = se2.retract(T_a_b, step[:3])
        nuisance = nuisance + step[3:]
        model_error = _estimate_model_error(r + J @ step, S)
    matches, _ = _associate(T_a_b, nuisance, pairs, model_error)
    return TrackRegistration(T_a_b, nuisance, matches, model_error) if len(matches) >= _MIN_MATCHES else None


def compute_pose_costs(T_a_b: Array, pairs: SimultaneousPairs, model_error: float) -> Array:
    """Truncated squared distances to the nearest neighbours over the gate: mean (K,) over a's samples.

    Covariances are replaced by their mean over all directions, for speed.
    """
    x_a, y_a = pairs.x_a.T
    x_b, y_b = pairs.x_b.T
    scale = 1 / (GATE * (pairs.variance + model_error**2))
    out = np.empty(len(T_a_b))
    for k, T in enumerate(T_a_b):  # the arrays of one pose fit into the processor's cache
        x = T[0, 0] * x_b + T[0, 1] * y_b + (T[0, 2] - x_a)
        y = T[1, 0] * x_b + T[1, 1] * y_b + (T[1, 2] - y_a)
        d2 = (x * x + y * y) * scale
        out[k] = np.minimum(np.minimum.reduceat(d2, pairs.run_starts_a), 1).mean()
    return out


def _associate(
    T_a_b: Array, nuisance: Array, pairs: SimultaneousPairs, model_error: float
) -> tuple[NDArray[np.intp], Array]:
    """Rows (P,) of mutual nearest neighbours within the gate, and their squared Mahalanobis distances."""
    differences = _compute_differences(T_a_b, nuisance, pairs)
    rough = np.sum(differences**2, axis=1) / (pairs.variance + model_error**2)
    # The exact covariance matters for the gate only, not for the choice of the nearest neighbour. Its largest
    # variance is at most twice the mean, so that this rough gate loses no match.
    near = np.flatnonzero(rough < 4 * GATE)
    if not len(near):
        return near, np.zeros(0)
    near = near[pairs.are_mutual_nearest(near, rough[near])]
    r, _, S = _linearize(T_a_b, nuisance, pairs, near)
    d2 = _mahalanobis2(r, invert_2x2(S + model_error**2 * np.eye(2)))
    return near[d2 < GATE], d2[d2 < GATE]


def _linearize(
    T: Array, nuisance: Array, pairs: SimultaneousPairs, rows: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Differences (P, 2) of positions in a's frame, Jacobians (P, 2, 6) by pose, clock, depths, covariances."""
    R = T[:2, :2]
    rotated = pairs.x_b[rows] @ R.T
    J = np.zeros((len(rows), 2, 6))
    J[:, 0, 0] = J[:, 1, 1] = 1
    J[:, 0, 2], J[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
    J[:, :, 3], J[:, :, 4], J[:, :, 5] = pairs.v_b[rows] @ R.T, -pairs.ray_a[rows], pairs.ray_b[rows] @ R.T
    S = pairs.a.covariances[pairs.row_a[rows]] + R @ pairs.b.covariances[pairs.row_b[rows]] @ R.T
    return _compute_differences(T, nuisance, pairs, rows), J, S


def _compute_differences(
    T: Array, nuisance: Array, pairs: SimultaneousPairs, rows: NDArray[np.intp] | slice = slice(None)
) -> Array:
    """Differences (P, 2) from a's to b's positions in a's frame, corrected for clock offset and depths."""
    clock_offset, depth_a, depth_b = nuisance
    corrected_a = pairs.x_a[rows] + depth_a * pairs.ray_a[rows]
    corrected_b = pairs.x_b[rows] + clock_offset * pairs.v_b[rows] + depth_b * pairs.ray_b[rows]
    return np.asarray(se2.apply(T, corrected_b) - corrected_a)


def _build_normal_equations(
    r: Array, J: Array, W: Array, nuisance: Array, prior: NuisancePrior
) -> tuple[Array, Array]:
    J, WJ = J.reshape(-1, 6), (W @ J).reshape(-1, 6)
    H = J.T @ WJ + np.diag(prior.information)
    g = WJ.T @ r.ravel() + prior.information * (np.append(np.zeros(3), nuisance) - prior.mean)
    return H + _RIDGE * np.eye(6), g


# Minimum standard deviation of distances beyond the tracks' covariances, m: a few matches may coincide by chance.
_MIN_MODEL_ERROR = 0.005
# Maximum standard deviation of distances beyond the tracks' covariances, and that of the coarse stage, m: half of
# a person's depth, as two scanners measure opposite sides.
MAX_MODEL_ERROR = 0.15


def _estimate_model_error(r: Array, S: Array) -> float:
    """Robust standard deviation (m) of the residuals beyond their covariances."""
    observed = float(np.median(np.sum(r**2, axis=1))) / CHI2_MEDIAN
    expected = float(np.mean(np.trace(S, axis1=1, axis2=2))) / 2
    error = np.sqrt(max(observed - expected, 0.0))
    return float(np.clip(error, _MIN_MODEL_ERROR, MAX_MODEL_ERROR))


# Minimum share of the residuals with another one at a lag, for it to enter the correlation time: of fewer, the
# autocorrelation is noise.
_MIN_LAG_SHARE = 0.1
# Lag at which the sum of autocorrelations ends at the latest, in steps of the pairs (10 s at every tick):
# residuals are correlated over some steps of a walk; the sum ends earlier where a pair of terms is negative.
_MAX_LAG = 100
# Shortest correlation time of residuals, s: people turn another side to a scanner at every step, which a few
# seconds of residuals alone understate.
_MIN_CORRELATION_TIME = 0.5
# Lower limit of the factor by which covariances are scaled to the residuals: few matches may coincide.
_MIN_VARIANCE_FACTOR = 0.1
# Standard deviation of errors that do not average out, m: the sides of a body and its gait as measured from two
# directions.
_SYSTEMATIC_STDDEV = 0.008


def compute_registration_covariance(
    fit: TrackRegistration, pairs: SimultaneousPairs, prior: NuisancePrior
) -> Array:
    """Covariance (4, 4) of the pose's error in the fixed axes of a, and of the clock, marginalized over depths.

    Errors of smoothed positions are correlated over seconds: the number of matches is divided by the correlation
    time of the residuals, in ticks.
    """
    rows = fit.matches
    r, J, S = _linearize(fit.T_a_b, fit.nuisance, pairs, rows)
    W = invert_2x2(S + fit.model_error**2 * np.eye(2))
    d2 = _mahalanobis2(r, W)
    whitened = np.einsum("pij,pj->pi", np.swapaxes(np.linalg.cholesky(W), 1, 2), r)
    ticks = pairs.a.tick[pairs.row_a[rows]]
    series = pairs.trajectories[rows]
    correlation = estimate_correlation_time(whitened, series, ticks, _MIN_LAG_SHARE, _MAX_LAG)
    correlation = max(correlation, to_ticks(_MIN_CORRELATION_TIME))
    degrees_of_freedom = max(2 * len(rows) / correlation - 6, 1.0)
    variance_factor = max(float(np.sum(d2)) / correlation / degrees_of_freedom, _MIN_VARIANCE_FACTOR)
    H, _ = _build_normal_equations(r, J, W / (variance_factor * correlation), fit.nuisance, prior)
    systematic = _systematic_covariance(fit.T_a_b, pairs.x_a[rows], _SYSTEMATIC_STDDEV)
    covariance = np.asarray(np.linalg.inv(H), dtype=np.float64)[:4, :4]
    covariance[:3, :3] += systematic
    return covariance


def _systematic_covariance(T_a_b: Array, x_a: Array, stddev: float) -> Array:
    """Covariance (3, 3) of the pose due to errors common to all positions (P, 2) and to those at either end."""
    center = x_a.mean(axis=0)
    extent = np.sqrt(np.mean(np.sum((x_a - center) ** 2, axis=1)))
    return rigid_motion_covariance(T_a_b, center, stddev, stddev / max(float(extent), _MIN_EXTENT))


def rigid_motion_covariance(T_a_b: Array, center: Array, shift: float, turn: float) -> Array:
    """Covariance (3, 3) of a pose with standard deviations of a shift (m) and of a turn (rad) about ``center``."""
    lever = center - T_a_b[:2, 2]
    G = np.eye(3)
    G[:2, 2] = lever[1], -lever[0]
    return np.asarray(G @ np.diag(np.array([shift, shift, turn]) ** 2) @ G.T)


def estimate_correlation_time(
    r: Array, series: NDArray[np.intp], ticks: NDArray[np.intp], min_lag_share: float, max_lag: int
) -> float:
    """Estimates the integrated autocorrelation time of residuals, in steps, >= 1.

    Args:
        r: (P, k) residuals of mean 0.
        series: (P,) index of the time series of each residual.
        ticks: (P,) their times, in steps.
        min_lag_share: share of the residuals with another one at a lag, below which the sum ends.
        max_lag: lag at which the sum ends otherwise, in steps.

    Source: Geyer, "Practical Markov chain Monte Carlo", 1992: the sum ends where a pair of terms is negative.
    """
    order = np.lexsort((ticks, series))
    r, key = r[order], series[order] * (int(ticks.max()) + 2 * max_lag) + ticks[order] - int(ticks.min())
    power = float(np.sum(r**2)) / max(len(r), 1)
    total, previous = 1.0, 0.0
    step = int(np.min(np.diff(np.unique(ticks)), initial=max_lag))
    for lag in range(1, max_lag):
        found = np.searchsorted(key, key + lag * step)
        pairs = np.flatnonzero(key[np.minimum(found, len(key) - 1)] == key + lag * step)
        if len(pairs) < min_lag_share * len(r):
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

"""Estimates the noise of ranges and the biases of scanners from the residuals at legs."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from calgraph.geometry import Array, Index, se_n
from calgraph.network.joint.leg_equations import compute_leg_residuals, raycast_leg
from calgraph.network.joint.leg_problem import LegObservations, LegPath
from calgraph.network.joint.path_covariance import compute_path_covariance
from calgraph.network.joint.path_equations import evaluate_at, index_scans
from calgraph.network.joint.problem import NetworkProblem, NetworkState
from calgraph.network.joint.range_noise import MAX_EXCESS, MIN_BEAMS, MIN_RATIO
from calgraph.network.joint.schur import BodyEquations, compute_back_substitution, pack_lower_band
from calgraph.network.joint.solver import NetworkEquations, compute_network_covariance

# Standard deviation of Gaussian noise as a multiple of its median absolute value.
_MEDIAN_TO_SIGMA = 1.4826
# Beams of a greater leverage determine the path: their residuals have no information.
_MAX_LEVERAGE = 0.7
# Beams whose range changes faster with their offset from the centre are near the edge, and not used.
_MAX_SLOPE = 1.0


@dataclass(frozen=True, eq=False)
class LegNoise:
    """Variances of the models of legs and scanners."""

    range_sigma: Array
    """(S,) noise of ranges, m."""
    bias_variance: float
    """Variance of the bias of a scanner's ranges to a leg, m²."""
    acceleration_density: float
    """Spectral density of the acceleration of legs, m²/s³."""


# Minimum standard deviation of this bias, m: below, it has no effect.
_MIN_BIAS_SIGMA = 0.0005
# Minimum and maximum spectral density of a leg's acceleration in the estimate of it, m²/s³. Legs that stand and
# swing in turns have 2 to 5 in the mean, which smooths swings too much: clocks of real legs are right with 10,
# and three times that of a fast walk is the limit above.
_ACCELERATION_DENSITY_RANGE = (10.0, 100.0)


def estimate_noise(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, background: Array
) -> LegNoise:
    """Estimates all variances from a solution of legs.

    Args:
        network: with the weights of its last solution.
        state: of that solution.
        equations: of that solution.
        background: (S,) noise of each scanner's background, m.
    """
    pass
    return LegNoise(
        _estimate_range_noise(network, state, equations, background),
        _estimate_bias_variance(network, state, equations, _MIN_BIAS_SIGMA),
        _estimate_acceleration_density(network, state, equations, _ACCELERATION_DENSITY_RANGE),
    )


def _estimate_acceleration_density(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, limits: tuple[float, float]
) -> float:
    """Squared second differences of the control points, over the number of them that the data determine.

    As for the biases, it is a step of the fixed-point iteration for restricted maximum likelihood, for given
    scanners and shapes.
    """
    of_legs = equations.batches.map(_measure_bends, network, state, equations.body_equations)
    squares, determined = np.sum(of_legs, axis=0) if of_legs else (0.0, 0.0)
    return float(np.clip(squares / max(determined, 1.0), *limits)) if of_legs else limits[1]


def _measure_bends(
    _network: NetworkProblem, _state: NetworkState, leg: LegObservations, path: LegPath, equations: BodyEquations
) -> tuple[float, float]:
    """Sum of squared second differences of one leg, and how many of them the data determine."""
    bend = np.diff(path.control[:, :2], 2, axis=0)
    covariance = np.trace(compute_path_covariance(equations.band)[..., :2, :2], axis1=2, axis2=3)
    at, next_, after = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    variance = at[:-2] + 4 * at[1:-1] + at[2:] - 4 * next_[:-2] - 4 * next_[1:-1] + 2 * after[:-2]
    prior = leg.knots.step**3 * leg.acceleration_density
    return float(np.sum(bend**2)) / leg.knots.step**3, float(np.sum(2 - np.minimum(variance / prior, 2)))


def _estimate_range_noise(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, background: Array
) -> Array:
    """(S,) noise of ranges, m: median absolute residual, each divided by the root of one minus its leverage.

    Scanners with few beams on legs have the noise (S,) of their background.
    """
    pass
    residuals: list[list[Array]] = [[] for _ in background]
    of_legs = equations.batches.map(_list_residuals, network, state, equations.body_equations)
    for leg, of_scanners in zip(network.bodies, of_legs, strict=True):
        for scans, absolute in zip(leg.scans, of_scanners, strict=True):
            residuals[scans.scanner].append(absolute)
    by_scanner = [np.concatenate([np.zeros(0), *parts]) for parts in residuals]
    estimated = [
        _MEDIAN_TO_SIGMA * np.median(absolute) if len(absolute) >= MIN_BEAMS else stated
        for absolute, stated in zip(by_scanner, background, strict=True)
    ]
    return np.asarray(np.clip(estimated, MIN_RATIO * background, np.hypot(background, MAX_EXCESS)))


def _list_residuals(
    network: NetworkProblem, state: NetworkState, leg: LegObservations, path: LegPath, equations: BodyEquations
) -> list[Array]:
    """Absolute residuals of each scanner's beams on one leg, corrected for their leverage, m."""
    path_covariance = compute_path_covariance(equations.band)[..., :2, :2]
    residuals = []
    for scans, bias in zip(leg.scans, path.bias.tolist(), strict=True):
        first, weights, pose, rate = evaluate_at(network, state, leg, path, scans)
        hits = raycast_leg(state, path, scans, pose, rate)
        residual, sigma = compute_leg_residuals(network, scans, hits, bias)
        covariance = _interpolate_covariance(path_covariance, first, weights)[index_scans(scans)]
        J = hits.jacobian[:, :2] / sigma[:, None]
        leverage = scans.weight * np.einsum("ni,nij,nj->n", J, covariance, J)
        used = (np.abs(hits.slope) < _MAX_SLOPE) & (leverage < _MAX_LEVERAGE)
        residuals.append(np.abs(residual * sigma)[used] / np.sqrt(1 - leverage[used]))
    return residuals


def _interpolate_covariance(path_covariance: Array, first: Index, weights: Array) -> Array:
    """(V, 2, 2) of the position at V scans, from those of control points (K, 4, 2, 2)."""
    total = np.zeros((len(first), 2, 2))
    for i in range(4):
        for j in range(i, 4):
            part = (weights[:, i] * weights[:, j])[:, None, None] * path_covariance[first + i, j - i]
            total += part if i == j else part + se_n.transpose(part)
    return total


def _estimate_bias_variance(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, min_sigma: float
) -> float:
    """Variance of the biases, m²: their sum of squares over the number of them that the data determine.

    It is a step of the fixed-point iteration for restricted maximum likelihood (Harville, 1977, section 5).
    """
    covariance = compute_network_covariance(equations)
    of_scanners = [covariance.select(columns) for columns in equations.columns]
    of_legs = equations.batches.map(_measure_biases, network, state, equations.body_equations, of_scanners)
    squares, determined = np.sum(of_legs, axis=0) if of_legs else (0.0, 0.0)
    return max(float(squares) / max(float(determined), 1.0), min_sigma**2)


def _measure_biases(
    _network: NetworkProblem,
    _state: NetworkState,
    leg: LegObservations,
    path: LegPath,
    equations: BodyEquations,
    covariance: Array,
) -> tuple[float, float]:
    """Sum of squared biases of one leg, and how many of them the data determine.

    The covariance (UL, UL) is that of the scanners.
    """
    by_scanners = compute_back_substitution(equations)[-len(path.bias) :, :-1]
    variance = _bias_variances(equations, len(path.bias))
    variance += np.einsum("ij,jk,ik->i", by_scanners, covariance, by_scanners)
    return float(path.bias @ path.bias), float(np.sum(1 - np.minimum(variance / leg.bias_variance, 1)))


def _bias_variances(equations: BodyEquations, count: int) -> Array:
    """(L,) variances of the biases, which are last in the shape, for given scanners."""
    shapes, size = equations.shape_count, 3 * len(equations.band)
    factor = cholesky_banded(pack_lower_band(equations.band), lower=True)
    border = equations.border.reshape(size, -1)[:, :shapes]
    information = equations.corner[:shapes, :shapes] - border.T @ cho_solve_banded((factor, True), border)
    return np.asarray(np.diagonal(np.linalg.inv(information))[-count:]).copy()

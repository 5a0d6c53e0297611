"""Estimates the noise of ranges from the residuals at bodies.

The static background gives a noise as well, but its medians are quantised as coarsely as the ranges are sent, and
clothes scatter more than walls. Residuals, in turn, are smaller than the noise, because paths are fitted to them:
the more so, the greater the leverage of the beams (Huber, "Robust statistics", 1981, section 7.2).
"""

from functools import partial

import numpy as np

from calgraph.geometry import Array, Index, estimate_spread
from calgraph.network.joint.body_equations import predict_beams
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, ScanEquations, TukeyLoss
from calgraph.network.joint.schur import BodyEquations, compute_path_covariance
from calgraph.network.joint.solver import NetworkEquations

# Beams of a scanner whose residuals are compared, evenly among all of longer recordings: the median of as many
# has a relative standard deviation of 0.8 %.
_MAX_BEAMS = 20_000
# Maximum mean leverage that is corrected for: the correction is an expansion to first order in it.
_MAX_LEVERAGE = 0.3
# Beams that are needed, otherwise the background's noise is used: the median of 300 has a relative standard
# deviation of 1.17 / sqrt(300) = 7 %.
MIN_BEAMS = 300
# Minimum noise as a ratio to the background's: quantised or simulated ranges may show none.
MIN_RATIO = 0.5
# Maximum noise beyond the background's, m: larger residuals are of other objects than the bodies.
MAX_EXCESS = 0.05


def estimate_range_noise(
    network: NetworkProblem, state: NetworkState, equations: NetworkEquations, background: Array
) -> Array:
    """(S,) noise of ranges, m: median absolute residual at bodies, corrected for the leverage of the beams.

    It is within bounds about the background's noise.

    Args:
        network: with the weights of its last solution.
        state: of that solution.
        equations: of that solution.
        background: (S,) noise of each scanner's background, m; used for scanners with few beams on bodies.
    """
    loss = TukeyLoss(TUKEY_LIMIT)
    residuals: list[list[Array]] = [[] for _ in background]
    leverage, effective_beams = np.zeros((2, len(background)))
    measure = partial(_measure_body, step=1 + network.count_beams() // _MAX_BEAMS)
    measured = equations.batches.map(measure, network, state, equations.body_equations)
    for body, of_scanners in zip(network.bodies, measured, strict=True):
        for scans, (absolute, of_path) in zip(body.scans, of_scanners, strict=True):
            residuals[scans.scanner].append(absolute)
            leverage[scans.scanner] += of_path
            effective_beams[scans.scanner] += scans.weight.sum() / loss.mean_weight
    by_scanner = [np.concatenate([np.zeros(0), *parts]) for parts in residuals]
    shrinkage = loss.median_shrinkage * np.minimum(leverage / np.maximum(effective_beams, 1), _MAX_LEVERAGE)
    sigma = [
        estimate_spread(absolute) / (1 - shrunk) if len(absolute) >= MIN_BEAMS else stated
        for absolute, shrunk, stated in zip(by_scanner, shrinkage, background, strict=True)
    ]
    return np.asarray(np.clip(sigma, MIN_RATIO * background, np.hypot(background, MAX_EXCESS)))


def _measure_body(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    equations: BodyEquations,
    step: Index,
) -> list[tuple[Array, float]]:
    """Every n-th (S,) absolute residual, m, and the sum of the leverages of each scanner's beams."""
    path_covariance = compute_path_covariance(equations.band)
    measured = []
    for beams in predict_beams(network, state, body, path):
        absolute = np.abs(beams.error)[beams.hits.frontal][:: step[beams.scans.scanner]].copy()
        scan_equations = beams.sum_over_scans().marginalize_model_error(network.model_error_variance[[0, 0, 1]])
        measured.append((absolute, _sum_leverages(beams.weights, beams.first, scan_equations, path_covariance)))
    return measured


def _sum_leverages(weights: Array, first: Index, equations: ScanEquations, path_covariance: Array) -> float:
    """The sum of the leverages of scans on a path with the given covariance of its control points."""
    A = equations.information[:, :3, :3]
    total = 0.0
    for i in range(4):
        for j in range(i, 4):
            trace = np.einsum("vij,vji->v", A, path_covariance[first + i, j - i])
            total += (1 + (i < j)) * float((weights[:, i] * weights[:, j]) @ trace)
    return total

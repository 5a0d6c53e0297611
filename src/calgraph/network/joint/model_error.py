"""Estimates how far bodies deviate from ellipses on smooth paths, from discrepancies between scanners.

Arms and shoulders swing with the steps: the errors of consecutive scans are correlated, and those of scanners on
different sides differ. Scanners are therefore compared stride by stride. The joint estimator treats scans as
independent, so the variance of a scan is chosen such that the covariance of a whole stride is right.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from calgraph.geometry import Array, Index, se_n
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.body_equations import predict_beams
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, ScanEquations, TukeyLoss
from calgraph.network.joint.scanner_unknowns import compute_root_times

# Variances that are tried together, and how many times: between the last of them, 8 % of a standard deviation
# apart, the logarithm of the discrepancy is linear.
_TRIALS, _REFINEMENTS = 9, 2
# Ridge (1/m², 1/rad²) that makes matrices invertible where there is no information.
_RIDGE = 1e-6


# Minimum standard deviation of a position, m: below a tenth of what the beams of one scan determine, it has no
# effect.
_MIN_POSITION_SIGMA = 0.0005
# Maximum standard deviation of a position, m: half the depth of a person.
MAX_POSITION_SIGMA = 0.1
# Minimum standard deviation of a heading, rad; as for positions.
_MIN_HEADING_SIGMA = 0.002
# Maximum standard deviation of a heading, rad: about 30°.
MAX_HEADING_SIGMA = 0.5


# Components of a pose that share one variance, in the order of ``model_error_variance``: their axes, and the least
# and the greatest standard deviation.
_COMPONENTS = (([0, 1], _MIN_POSITION_SIGMA, MAX_POSITION_SIGMA), ([2], _MIN_HEADING_SIGMA, MAX_HEADING_SIGMA))


@dataclass(frozen=True, eq=False)
class _ScanEquations:
    """The equations of one body's pose, before the model error is marginalised."""

    scans: ScanEquations
    """Of all scanners, over the body's pose only."""
    part: Index
    """(V,) of each scan: a stride of a scanner, whose scanners are numbered one after the other."""
    scanners: int
    """Number of scanners, L."""


# Beams of the bodies that are compared, evenly among all of larger networks: those of about 1500 strides of 5
# scanners, which determine a standard deviation to 2 %.
_MAX_BEAMS = 500_000


def estimate_model_error(network: NetworkProblem, state: NetworkState, batches: BodyBatches) -> Array:
    """(2,) variances of position (m²) and heading (rad²) that explain the discrepancies between scanners.

    Each is found as the root of an equation, given the other. Multiplying it repeatedly by the ratio of observed
    to expected discrepancy has the same fixed point, but converges slowly where the model error is small beside
    the noise of a scan. Where no two scanners measure a body within one stride, a variance keeps its value.

    Args:
        network: the problem.
        state: near its minimum.
        batches: the bodies.
    """
    beams = int(network.count_beams().sum())
    batches = batches.thin(1 + beams // _MAX_BEAMS)
    kept = batches.keep(_collect_equations, network, state)
    score_to_information = TukeyLoss(TUKEY_LIMIT).score_to_information
    variances = network.model_error_variance.copy()

    def compute_log_ratios(index: int, axes: list[int], log_variances: Array) -> tuple[Array, Array]:
        """Logarithms (n,) of observed over expected discrepancies, and the latter, for trials of a variance."""
        trials = np.tile(variances, (len(log_variances), 1))
        trials[:, index] = np.exp(log_variances)
        compare = partial(_compare_scanners, trials=trials, axes=np.array(axes))
        observed, expected = sum(batches.map_values(compare, kept), np.zeros((len(trials), 2))).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(observed / (score_to_information * expected)), expected

    for index, (axes, least, most) in enumerate(_COMPONENTS):
        log_ratios = partial(compute_log_ratios, index, axes)
        variances[index] = _find_variance(log_ratios, least, most, float(variances[index]))
    return variances


def _find_variance(
    compute_log_ratios: Callable[[Array], tuple[Array, Array]], min_sigma: float, max_sigma: float, present: float
) -> float:
    """The variance of one component, at which the log ratio is zero; it decreases with the variance.

    Several variances are tried together, as a call for each would be too short for other processes.
    """
    low, high = 2 * np.log([min_sigma, max_sigma])
    for refinement in range(_REFINEMENTS):
        grid = np.linspace(low, high, _TRIALS)
        log_ratio, expected = compute_log_ratios(grid)
        if refinement == 0 and expected[0] < max_sigma**-2:
            return present
        if log_ratio[0] <= 0:
            return float(np.exp(low))
        if log_ratio[-1] >= 0:
            return float(np.exp(high))
        below = int(np.argmax(log_ratio < 0))
        low, high = grid[below - 1 : below + 1]
        before, after = log_ratio[below - 1 : below + 1]
    return float(np.exp(low + (high - low) * before / (before - after)))


# Scanners are compared over this time, s: two steps of a walk, the period in which arms swing and deviations are
# correlated.
_STRIDE_DURATION = 1.0


def _collect_equations(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> _ScanEquations:
    """The equations of a body."""
    duration = _STRIDE_DURATION
    collected, parts = [], []
    for k, beams in enumerate(predict_beams(network, state, body, path)):
        stride = (compute_root_times(network, state, beams.scans) - body.knots.start) / duration
        collected.append(beams.sum_over_scans())
        parts.append(np.maximum(stride, 0).astype(np.intp) * len(body.scans) + k)
    part = np.concatenate(parts)
    order = np.argsort(part, kind="stable")
    of_pose = ScanEquations(
        np.concatenate([one.information[:, :3, :3] for one in collected])[order],
        np.concatenate([one.gradient[:, :3] for one in collected])[order],
        np.concatenate([one.cost for one in collected])[order],
    )
    return _ScanEquations(of_pose, part[order], len(body.scans))


def _compare_scanners(equations: _ScanEquations, trials: Array, axes: Index) -> Array:
    """(n, 2) sum of squared discrepancies between scanners about a body, and its expectation, for n trials."""
    return np.array([_compare_for_variances(equations, variances, axes) for variances in trials])


def _compare_for_variances(equations: _ScanEquations, variances: Array, axes: Index) -> Array:
    """(2,) sum of squared discrepancies between scanners about a body, and its expectation.

    The gradients ``b`` of a scanner's beams in a stride have the covariance ``A``, their information. The other
    component of the pose is free for each scanner. At the pose that balances all scanners, their gradients have
    the covariance ``A - A (Σ A)⁻¹ A``.
    """
    strides = 1 + int(equations.part.max(initial=0)) // equations.scanners
    A, b = np.zeros((strides, equations.scanners, 3, 3)), np.zeros((strides, equations.scanners, 3))
    scans = equations.scans.marginalize_model_error(variances[[0, 0, 1]])
    first = np.flatnonzero(np.diff(equations.part, prepend=-1))
    if len(first):
        at = np.divmod(equations.part[first], equations.scanners)
        A[at], b[at] = np.add.reduceat(scans.information, first), np.add.reduceat(scans.gradient, first)
    others = np.setdiff1d(np.arange(3), axes)
    mixed = A[..., axes[:, None], others]
    gain = mixed @ np.linalg.inv(A[..., others[:, None], others] + _RIDGE * np.eye(len(others)))
    A = A[..., axes[:, None], axes] - gain @ se_n.transpose(mixed)
    b = b[..., axes] - (gain @ b[..., others, None])[..., 0]
    several = np.sum(np.trace(A, axis1=-2, axis2=-1) > 0, axis=1) > 1
    A, b = A[several], b[several]
    pose_covariance = np.linalg.inv(A.sum(axis=1) + _RIDGE * np.eye(len(axes)))
    discrepancy = b - (A @ (pose_covariance @ b.sum(axis=1)[..., None])[:, None])[..., 0]
    expected = A - A @ pose_covariance[:, None] @ A
    return np.array([np.sum(discrepancy**2), np.sum(np.trace(expected, axis1=-2, axis2=-1))])

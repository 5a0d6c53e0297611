"""Estimates how far bodies deviate from ellipses on smooth paths, from discrepancies between scanners.

Arms and shoulders swing with the steps: the errors of consecutive scans are correlated, and those of scanners on
different sides differ. Scanners are therefore compared stride by stride. The joint estimator treats scans as
independent, so the variance of a scan is chosen such that the covariance of a whole stride is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from calgraph.config.settings import ModelErrorSettings
from calgraph.estimation.network.path_equations import evaluate_at
from calgraph.estimation.network.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.estimation.network.scan_equations import ScanEquations
from calgraph.estimation.network.scanner_unknowns import compute_root_times
from calgraph.estimation.network.solver import build_scan_equations
from calgraph.estimation.network.tukey_loss import TukeyLoss
from calgraph.geometry import Array, Index, se_n

# Tolerance of the logarithm of a variance: 1 % of a standard deviation.
_LOG_TOLERANCE = 0.02
# Ridge (1/m², 1/rad²) that makes matrices invertible where there is no information.
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class _Component:
    """Components of a pose that share one variance."""

    axes: Index
    """Of the pose."""
    min_sigma: float
    """Least standard deviation, m or rad."""
    max_sigma: float
    """Greatest standard deviation, m or rad."""


def _list_components(settings: ModelErrorSettings) -> tuple[_Component, _Component]:
    """Position and heading, in the order of :attr:`NetworkProblem.model_error_variance`."""
    return (
        _Component(np.array([0, 1]), settings.min_position_sigma, settings.max_position_sigma),
        _Component(np.array([2]), settings.min_heading_sigma, settings.max_heading_sigma),
    )


@dataclass(frozen=True, eq=False)
class _ScannerEquations:
    """One scanner's equations of one body, before the model error is marginalised."""

    scans: ScanEquations
    """Over the body's pose only."""
    stride: Index
    """(V,) of each scan."""


def estimate_model_error(network: NetworkProblem, state: NetworkState) -> Array:
    """(2,) variances of position (m²) and heading (rad²) that explain the discrepancies between scanners.

    Each is found as the root of an equation, given the other. Multiplying it repeatedly by the ratio of observed
    to expected discrepancy has the same fixed point, but converges slowly where the model error is small beside
    the noise of a scan. Where no two scanners measure a body within one stride, a variance keeps its value.
    """
    bodies = [_collect_equations(network, state, *pair) for pair in zip(network.bodies, state.paths, strict=True)]
    score_to_information = TukeyLoss(network.settings.beams.tukey_limit).score_to_information
    variances = network.model_error_variance.copy()
    for index, component in enumerate(_list_components(network.settings.model_error)):
        variances[index] = _find_variance(bodies, variances, index, component, score_to_information)
    return variances


def _find_variance(
    bodies: Sequence[tuple[_ScannerEquations, ...]],
    variances: Array,
    index: int,
    component: _Component,
    score_to_information: float,
) -> float:
    """The variance of one component, with the other as in ``variances`` (2,)."""

    def sum_discrepancies(log_variance: float) -> Array:
        trial = variances.copy()
        trial[index] = np.exp(log_variance)
        return np.asarray(
            np.sum([np.zeros(2), *(_compare_scanners(body, trial, component) for body in bodies)], axis=0)
        )

    def log_ratio(log_variance: float) -> float:
        observed, expected = sum_discrepancies(log_variance)
        return float(np.log(observed / (score_to_information * expected)))

    low, high = 2 * np.log([component.min_sigma, component.max_sigma])
    if sum_discrepancies(low)[1] < component.max_sigma**-2:
        return float(variances[index])
    if log_ratio(low) <= 0:
        return component.min_sigma**2
    if log_ratio(high) >= 0:
        return component.max_sigma**2
    return float(np.exp(brentq(log_ratio, low, high, xtol=_LOG_TOLERANCE)))


def _collect_equations(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> tuple[_ScannerEquations, ...]:
    """By scanner."""
    duration = network.settings.model_error.stride_duration
    collected = []
    for scans in body.scans:
        _, _, pose, rate = evaluate_at(network, state, body, path, scans)
        stride = (compute_root_times(network, state, scans) - body.knots.start) / duration
        equations = build_scan_equations(network, state, path, scans, pose, rate)
        of_pose = ScanEquations(equations.information[:, :3, :3], equations.gradient[:, :3], equations.cost)
        collected.append(_ScannerEquations(of_pose, np.maximum(stride, 0).astype(np.intp)))
    return tuple(collected)


def _compare_scanners(body: tuple[_ScannerEquations, ...], variances: Array, component: _Component) -> Array:
    """(2,) sum of squared discrepancies between scanners about a body, and its expectation.

    The gradients ``b`` of a scanner's beams in a stride have the covariance ``A``, their information. The other
    component of the pose is free for each scanner. At the pose that balances all scanners, their gradients have
    the covariance ``A - A (Σ A)⁻¹ A``.
    """
    strides = 1 + max(int(scanner.stride.max(initial=0)) for scanner in body)
    A, b = np.zeros((strides, len(body), 3, 3)), np.zeros((strides, len(body), 3))
    for k, scanner in enumerate(body):
        scans = scanner.scans.marginalize_model_error(variances[[0, 0, 1]])
        np.add.at(A[:, k], scanner.stride, scans.information)
        np.add.at(b[:, k], scanner.stride, scans.gradient)
    axes, others = component.axes, np.setdiff1d(np.arange(3), component.axes)
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

"""Variance components: noise of measurements, bias of views; and the test for outlier views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri

from calgraph.config.settings import VarianceComponentSettings
from calgraph.estimation.rig.bundle_solver import Bundle, BundleEquations, MinimizedBundle
from calgraph.estimation.rig.normal_equations import consistency_statistic, huber_variance_factor, whitening
from calgraph.estimation.rig.observations import relative_poses
from calgraph.geometry import Array, Index


def update_variance_components(
    bundle: Bundle, solution: MinimizedBundle, factors: Sequence[Array], first: int = 0
) -> Bundle:
    """The bundle after one step of Fisher scoring for the variances of noise and view bias (REML).

    Within a view, measurements scatter about its best fit. That determines the noise poorly where views have
    few measurements, such as the two end points of a line on the board; but views scatter among each other with
    the noise as well as with the bias, so both are estimated jointly.

    The gradients of views have the covariance ``W = A - A P A`` if noise and bias are right. Views of one board
    are correlated, so sensors are scored jointly; the correlation between boards, through the sensors' poses, is
    neglected.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
    1971.

    Args:
        bundle: sensors' and outlines' views.
        solution: its solution.
        factors: (K,) of :func:`calgraph.estimation.rig.covariances.view_covariance_factors`.
        first: index of the first views whose components are estimated; those before it keep theirs.
    """
    statistics = [_view_statistics(bundle, solution.equations, k, factors[k]) for k in range(first, len(factors))]
    settings = bundle.settings.variances
    # Noise and bias of each in turn.
    score = np.concatenate([one.score for one in statistics])
    fisher = np.zeros((len(score), len(score)))
    for i, one in enumerate(statistics):
        fisher[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = one.fisher
        for j, other in enumerate(statistics[:i]):
            _, here, there = np.intersect1d(one.board, other.board, assume_unique=True, return_indices=True)
            W = one.solution_factors[here] @ np.swapaxes(other.solution_factors[there], -1, -2)
            between = _sum_blocks(np.sum(W**2, axis=0), one.noise_directions, other.noise_directions)
            fisher[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = between
            fisher[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = between.T
    before = np.column_stack([np.ones(len(statistics)), bundle.bias_variance[first:]]).ravel()
    least = np.array([[one.bounds[0], 0.0] for one in statistics]).ravel()
    most = np.array([[one.bounds[1], np.inf] for one in statistics]).ravel()
    noise, bias = (
        np.minimum(_fisher_scoring_step(before, score, fisher, least, settings.fisher_ridge), most)
        .reshape(-1, 2)
        .T
    )
    freedom, state = fisher.diagonal()[::2], solution.state
    all_views = list(bundle.all_views)
    for i, views in enumerate(bundle.all_views[first:]):
        scale = _shrink_noise_scale(views.noise_scale**2 * noise[i], freedom[i], settings)
        if abs(scale / views.noise_scale - 1) >= settings.min_noise_change:
            T_root_sensor = state.T_root_sensor[bundle.sensor_of(first + i)]
            T_sensor_board = relative_poses(T_root_sensor, state.T_root_board[views.board])
            all_views[first + i] = views.update_noise(T_sensor_board, scale)
    return replace(bundle.with_views(all_views), bias_variance=np.append(bundle.bias_variance[:first], bias))


@dataclass(frozen=True, eq=False)
class _ViewStatistics:
    """Likelihood of the variances of noise, relative to the present one, and of the bias, for one set of views."""

    board: Index
    """(V,)."""
    noise_directions: int
    """Number of the first of m directions, where noise has unit covariance; the others are those of the bias."""
    solution_factors: Array
    """(V, m, r) factors of the reduction of the gradients' covariance by the solution, in these directions."""
    score: Array
    """(2,) twice the derivative of the log-likelihood by the variances of noise and bias."""
    fisher: Array
    """(2, 2) twice their Fisher information."""
    bounds: tuple[float, float]
    """Of the noise variance in one step."""


def _view_statistics(bundle: Bundle, equations: BundleEquations, k: int, factors: Array) -> _ViewStatistics:
    """Those of views k, with their ``factors`` of :func:`view_covariance_factors`."""
    unmarginalized, at, views = equations.cache[k].equations, equations.views[k], bundle.all_views[k]
    squares, freedom = unmarginalized.within_view_scatter()
    unit = np.sqrt(replace(bundle, bias_variance=np.ones_like(bundle.bias_variance)).bias_variances(k))
    bias_directions = unit[:, None] * np.swapaxes(at.local_jacobian, -1, -2)
    directions = np.concatenate([whitening(unmarginalized.JtJ)[0], bias_directions], axis=1)
    solution_factors, noise_directions = directions @ at.information @ factors, unmarginalized.JtJ.shape[-1]
    W = directions @ at.information @ np.swapaxes(directions, -1, -2)
    W = W - solution_factors @ np.swapaxes(solution_factors, -1, -2)
    among = np.sum((directions @ at.gradient[..., None])[..., 0] ** 2, axis=0)
    expected = np.diagonal(W.sum(axis=0))
    score = np.add.reduceat(among - expected, [0, noise_directions])
    fisher = _sum_blocks(np.sum(W**2, axis=0), noise_directions, noise_directions)
    within, freedom = (
        squares.sum() / huber_variance_factor(views.dimension, bundle.settings.huber_threshold),
        freedom.sum(),
    )
    score[0] += within - freedom
    fisher[0, 0] += freedom
    max_factor = bundle.settings.variances.max_variance_factor
    expected_among = expected[:noise_directions].sum()
    low, high = (
        (within + factor * expected_among) / max(freedom + expected_among, 1.0)
        for factor in (1 / max_factor, max_factor)
    )
    return _ViewStatistics(
        views.board, noise_directions, solution_factors, score, fisher, (float(low), float(high))
    )


def _sum_blocks(squares: Array, rows: int, columns: int) -> Array:
    """(2, 2) sums over the blocks of a matrix: of the first rows and columns, and of the others."""
    return np.asarray(np.add.reduceat(np.add.reduceat(squares, [0, rows], axis=0), [0, columns], axis=1))


def _shrink_noise_scale(variance: float, freedom: float, settings: VarianceComponentSettings) -> float:
    """Noise over that stated, shrunk towards 1, from its estimated variance with ``freedom`` degrees of freedom.

    The stated noise is uncertain by a factor, so logarithms are averaged: in a mean of variances, noise stated ten
    times too large would weigh as a hundred measurements.
    """
    least = settings.min_noise_ratio**2
    return float(np.sqrt(max(variance, least)) ** (freedom / (freedom + settings.stated_noise_weight)))


def _fisher_scoring_step(variances: Array, score: Array, fisher: Array, least: Array, ridge: float) -> Array:
    """Variances after one step of Fisher scoring, none of them below the least."""
    # Two sensors alone determine the sum of their variances only: the ridge keeps the difference.
    regularized = fisher + np.diag(ridge * np.diag(fisher) + np.finfo(float).tiny)
    root = np.linalg.cholesky(regularized).T
    above, _ = nnls(root, root @ (variances - least) + np.linalg.solve(root.T, score))
    return np.asarray(least + above)


def find_outlier_views(
    bundle: Bundle, equations: BundleEquations, factors: Sequence[Array], first: int = 0
) -> list[NDArray[np.bool_]]:
    """By view set, a mask (V,) of the views that contradict the others: of each board the worst one only.

    A gross outlier biases all sensors: views with much smaller statistics are tested after it has been rejected.

    Args:
        bundle: sensors' and outlines' views.
        equations: at its solution.
        factors: (K,) of :func:`calgraph.estimation.rig.covariances.view_covariance_factors`.
        first: index of the first views to test.
    """
    settings = bundle.settings.variances
    excess = [np.zeros(len(views.board)) for views in bundle.all_views]
    worst: Array = np.zeros(len(equations.H_board))
    for k, views in enumerate(bundle.all_views[first:], start=first):
        at, F = equations.views[k], factors[k]
        squared, freedom = consistency_statistic(
            at.information, F @ np.swapaxes(F, -1, -2), at.gradient, settings.min_redundancy
        )
        excess[k] = squared / chdtri(np.maximum(freedom, 1), settings.outlier_significance)
        worst[views.board] = np.maximum(worst[views.board], excess[k])
    limit = max(1.0, settings.min_share_of_worst * worst.max(initial=0.0))
    return [
        np.asarray((over > limit) & (over >= worst[views.board]), dtype=np.bool_)
        for views, over in zip(bundle.all_views, excess, strict=True)
    ]

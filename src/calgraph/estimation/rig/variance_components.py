"""How large errors are, told from their scatter: of measurements, of whole views; and which views are wrong."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri

from calgraph.estimation.rig.bundle_solver import Bundle, BundleEquations, MinimizedBundle
from calgraph.estimation.rig.normal_equations import consistency_statistic, huber_variance_factor, whitening
from calgraph.estimation.rig.observations import relative_poses
from calgraph.geometry import Array, Index

# Noise that has changed by less than this share has not changed.
_MIN_NOISE_CHANGE = 5e-3
# How firmly the stated noise is believed, in measured numbers: it is off by a factor of 1.5, more or less.
_STATED_NOISE_WEIGHT = 3
# Measurements are never taken to be more precise than this share of what is stated.
_MIN_NOISE_SCALE = 0.01
# By which share of its Fisher information each noise and sway holds on to what it is.
_FISHER_RIDGE = 0.01
# Views' scatter changes a noise's variance by this factor at most, at once.
_MAX_VARIANCE_FACTOR = 4.0
# A view is wrong if it is as far from the others as chance would have it once in so many.
_OUTLIER_CHANCE = 1e-5
# Views less wrong than this share of the worst wait until that is left out.
_MIN_SHARE_OF_WORST = 0.25


def update_variance_components(
    bundle: Bundle, solved: MinimizedBundle, spreads: Sequence[Array], first: int = 0
) -> Bundle:
    """The bundle with all noises and sways one step nearer to what scatters: measurements in views, and views.

    In a view, measurements scatter about the board that fits it best. Where views have few of them, as where a
    line of a scan leaves a sheet twice, that tells little; but then views scatter with the noise, too, not only
    with the sway, so both are told together.

    Fisher scoring of the restricted likelihood: views' gradients have the covariance ``W = A - A P A`` if noise
    and sway are right. Views of one board explain each other's scatter, so sensors are scored together; that of
    different boards goes together only as far as sensors are uncertain, and is left out.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
    1971.

    Args:
        bundle: sensors' and outlines' views.
        solved: its solution.
        spreads: (K,) as of :func:`calgraph.estimation.rig.covariances.view_spreads`.
        first: of the views to measure; those before it keep their noise and sway.
    """
    told = [_view_statistics(bundle, solved.equations, k, spreads[k]) for k in range(first, len(spreads))]
    # Noise and sway of each in turn.
    score = np.concatenate([one.score for one in told])
    fisher = np.zeros((len(score), len(score)))
    for i, one in enumerate(told):
        fisher[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = one.fisher
        for j, other in enumerate(told[:i]):
            _, here, there = np.intersect1d(one.board, other.board, assume_unique=True, return_indices=True)
            W = one.solution_factors[here] @ np.swapaxes(other.solution_factors[there], -1, -2)
            between = _sum_blocks(np.sum(W**2, axis=0), one.noise_directions, other.noise_directions)
            fisher[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = between
            fisher[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = between.T
    before = np.column_stack([np.ones(len(told)), bundle.bias_variance[first:]]).ravel()
    least = np.array([[one.bounds[0], 0.0] for one in told]).ravel()
    most = np.array([[one.bounds[1], np.inf] for one in told]).ravel()
    noise, sway = np.minimum(_fisher_scoring_step(before, score, fisher, least), most).reshape(-1, 2).T
    numbers, state = fisher.diagonal()[::2], solved.state
    views = list(bundle.all_views)
    for i, own in enumerate(bundle.all_views[first:]):
        scale = _shrink_noise_scale(own.noise_scale**2 * noise[i], numbers[i])
        if abs(scale / own.noise_scale - 1) >= _MIN_NOISE_CHANGE:
            T_root_sensor = state.T_root_sensor[bundle.sensor_of(first + i)]
            views[first + i] = own.update_noise(
                relative_poses(T_root_sensor, state.T_root_board[own.board]), scale
            )
    return replace(bundle.with_views(views), bias_variance=np.append(bundle.bias_variance[:first], sway))


@dataclass(frozen=True, eq=False)
class _ViewStatistics:
    """What the views of one sensor or outline tell of their noise, as a share of what it is, and of their sway."""

    board: Index
    """(V,)."""
    noise_directions: int
    """So many of m directions, the first ones, are those of noise with unit covariance; the others are of sway."""
    solution_factors: Array
    """(V, m, r) factors of what the solution takes of the gradients' covariance, along these directions."""
    score: Array
    """(2,) twice the slope of the logarithmic likelihood by noise and sway."""
    fisher: Array
    """(2, 2) twice their Fisher information."""
    bounds: tuple[float, float]
    """Between which the noise is believed to be: what scatters among views is, in one step, up to a factor."""


def _view_statistics(bundle: Bundle, system: BundleEquations, k: int, spread: Array) -> _ViewStatistics:
    """What the views of one sensor or outline tell, whose factors of :func:`view_spreads` are ``spread``."""
    sums, at, own = system.cache[k].equations, system.views[k], bundle.all_views[k]
    squares, freedom = sums.within_view_scatter()
    unit = np.sqrt(replace(bundle, bias_variance=np.ones_like(bundle.bias_variance)).bias_variances(k))
    along = np.concatenate(
        [whitening(sums.JtJ)[0], unit[:, None] * np.swapaxes(at.local_jacobian, -1, -2)], axis=1
    )
    pulls, noises = along @ at.information @ spread, sums.JtJ.shape[-1]
    W = along @ at.information @ np.swapaxes(along, -1, -2) - pulls @ np.swapaxes(pulls, -1, -2)
    among = np.sum((along @ at.gradient[..., None])[..., 0] ** 2, axis=0)
    expected = np.diagonal(W.sum(axis=0))
    score = np.add.reduceat(among - expected, [0, noises])
    fisher = _sum_blocks(np.sum(W**2, axis=0), noises, noises)
    within, freedom = squares.sum() / huber_variance_factor(own.dimension), freedom.sum()
    score[0] += within - freedom
    fisher[0, 0] += freedom
    others = expected[:noises].sum()
    low, high = (
        (within + share * others) / max(freedom + others, 1.0)
        for share in (1 / _MAX_VARIANCE_FACTOR, _MAX_VARIANCE_FACTOR)
    )
    return _ViewStatistics(own.board, noises, pulls, score, fisher, (float(low), float(high)))


def _sum_blocks(squares: Array, rows: int, columns: int) -> Array:
    """(2, 2) sums over the blocks of a matrix: of the first rows and columns, and of the others."""
    return np.asarray(np.add.reduceat(np.add.reduceat(squares, [0, rows], axis=0), [0, columns], axis=1))


def _shrink_noise_scale(squared: float, numbers: float) -> float:
    """How many times larger than stated noise is, if its square is told to be ``squared`` by so many numbers.

    What is stated is off by a factor, if it is: logarithms are averaged. In a mean of squares, one stated ten
    times too large would count as a hundred numbers do.
    """
    return float(np.sqrt(max(squared, _MIN_NOISE_SCALE**2)) ** (numbers / (numbers + _STATED_NOISE_WEIGHT)))


def _fisher_scoring_step(variances: Array, score: Array, fisher: Array, least: Array) -> Array:
    """Variances one step of Fisher scoring up the likelihood, none of them below the least."""
    # Of two sensors alone only the sum is known: what the scatter does not tell stays.
    firm = fisher + np.diag(_FISHER_RIDGE * np.diag(fisher) + np.finfo(float).tiny)
    root = np.linalg.cholesky(firm).T
    above, _ = nnls(root, root @ (variances - least) + np.linalg.solve(root.T, score))
    return np.asarray(least + above)


def find_outlier_views(
    bundle: Bundle, system: BundleEquations, spreads: Sequence[Array], first: int = 0
) -> list[NDArray[np.bool_]]:
    """By sensor and outline, (V,) which views contradict the others: of a board the worst, which bends the others.

    Views that are far worse than the rest bend all sensors: those that are less wrong are judged without them.

    Args:
        bundle: sensors' and outlines' views.
        system: their equations at the solution.
        spreads: (K,) as of :func:`calgraph.estimation.rig.covariances.view_spreads`.
        first: of those to judge; those before it are taken to be right.
    """
    excess = [np.zeros(len(views.board)) for views in bundle.all_views]
    worst: Array = np.zeros(len(system.H_board))
    for k, views in enumerate(bundle.all_views[first:], start=first):
        at, F = system.views[k], spreads[k]
        squared, freedom = consistency_statistic(at.information, F @ np.swapaxes(F, -1, -2), at.gradient)
        excess[k] = squared / chdtri(np.maximum(freedom, 1), _OUTLIER_CHANCE)
        worst[views.board] = np.maximum(worst[views.board], excess[k])
    limit = max(1.0, _MIN_SHARE_OF_WORST * worst.max(initial=0.0))
    return [
        np.asarray((over > limit) & (over >= worst[views.board]), dtype=np.bool_)
        for views, over in zip(bundle.all_views, excess, strict=True)
    ]

"""How large errors are, told from their scatter: of measurements, of whole views; and which views are wrong."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri

from calgraph.estimation.rig.bundle_solver import Bundle, Solved, System
from calgraph.estimation.rig.normal_equations import huber_scatter, misfit, whitening
from calgraph.estimation.rig.observations import relative
from calgraph.geometry import Array, Index

# Noise that has changed by less than this share has not changed.
_SAME = 5e-3
# How firmly the stated noise is believed, in measured numbers: it is off by a factor of 1.5, more or less.
_FIRM = 3
# Measurements are never taken to be more precise than this share of what is stated.
_SHARPEST = 0.01
# By which share of its Fisher information each noise and sway holds on to what it is.
_INERT = 0.01
# Views' scatter changes a noise's variance by this factor at most, at once.
_STRIDE = 4.0
# A view is wrong if it is as far from the others as chance would have it once in so many.
_CHANCE = 1e-5
# Views less wrong than this share of the worst wait until that is left out.
_WAITING = 0.25


def with_measured_scatter(bundle: Bundle, solved: Solved, spreads: Sequence[Array], first: int = 0) -> Bundle:
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
    told = [_of_views(bundle, solved.system, k, spreads[k]) for k in range(first, len(spreads))]
    # Noise and sway of each in turn.
    score = np.concatenate([one.score for one in told])
    fisher = np.zeros((len(score), len(score)))
    for i, one in enumerate(told):
        fisher[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = one.fisher
        for j, other in enumerate(told[:i]):
            _, here, there = np.intersect1d(one.board, other.board, assume_unique=True, return_indices=True)
            W = one.pulls[here] @ np.swapaxes(other.pulls[there], -1, -2)
            between = _blocks(np.sum(W**2, axis=0), one.noises, other.noises)
            fisher[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = between
            fisher[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = between.T
    before = np.column_stack([np.ones(len(told)), bundle.sway[first:]]).ravel()
    least = np.array([[one.bounds[0], 0.0] for one in told]).ravel()
    most = np.array([[one.bounds[1], np.inf] for one in told]).ravel()
    noise, sway = np.minimum(_ascended(before, score, fisher, least), most).reshape(-1, 2).T
    numbers, state = fisher.diagonal()[::2], solved.state
    views = list(bundle.all_views)
    for i, own in enumerate(bundle.all_views[first:]):
        scale = _scale(own.scale**2 * noise[i], numbers[i])
        if abs(scale / own.scale - 1) >= _SAME:
            T_root_sensor = state.T_root_sensor[bundle.seer(first + i)]
            views[first + i] = own.weighed(relative(T_root_sensor, state.T_root_board[own.board]), scale)
    return replace(bundle.with_views(views), sway=np.append(bundle.sway[:first], sway))


@dataclass(frozen=True, eq=False)
class _Told:
    """What the views of one sensor or outline tell of their noise, as a share of what it is, and of their sway."""

    board: Index
    """(V,)."""
    noises: int
    """So many of m directions, the first ones, are those of noise with unit covariance; the others are of sway."""
    pulls: Array
    """(V, m, r) factors of what the solution takes of the gradients' covariance, along these directions."""
    score: Array
    """(2,) twice the slope of the logarithmic likelihood by noise and sway."""
    fisher: Array
    """(2, 2) twice their Fisher information."""
    bounds: tuple[float, float]
    """Between which the noise is believed to be: what scatters among views is, in one step, up to a factor."""


def _of_views(bundle: Bundle, system: System, k: int, spread: Array) -> _Told:
    """What the views of one sensor or outline tell, whose factors of :func:`view_spreads` are ``spread``."""
    sums, at, own = system.visits[k].sums, system.views[k], bundle.all_views[k]
    squares, freedom = sums.scatter()
    unit = np.sqrt(replace(bundle, sway=np.ones_like(bundle.sway)).swaying(k))
    along = np.concatenate([whitening(sums.core)[0], unit[:, None] * np.swapaxes(at.basis, -1, -2)], axis=1)
    pulls, noises = along @ at.information @ spread, sums.core.shape[-1]
    W = along @ at.information @ np.swapaxes(along, -1, -2) - pulls @ np.swapaxes(pulls, -1, -2)
    among = np.sum((along @ at.gradient[..., None])[..., 0] ** 2, axis=0)
    expected = np.diagonal(W.sum(axis=0))
    score = np.add.reduceat(among - expected, [0, noises])
    fisher = _blocks(np.sum(W**2, axis=0), noises, noises)
    within, freedom = squares.sum() / huber_scatter(own.numbers), freedom.sum()
    score[0] += within - freedom
    fisher[0, 0] += freedom
    others = expected[:noises].sum()
    low, high = ((within + share * others) / max(freedom + others, 1.0) for share in (1 / _STRIDE, _STRIDE))
    return _Told(own.board, noises, pulls, score, fisher, (float(low), float(high)))


def _blocks(squares: Array, rows: int, columns: int) -> Array:
    """(2, 2) sums over the blocks of a matrix: of the first rows and columns, and of the others."""
    return np.asarray(np.add.reduceat(np.add.reduceat(squares, [0, rows], axis=0), [0, columns], axis=1))


def _scale(squared: float, numbers: float) -> float:
    """How many times larger than stated noise is, if its square is told to be ``squared`` by so many numbers.

    What is stated is off by a factor, if it is: logarithms are averaged. In a mean of squares, one stated ten
    times too large would count as a hundred numbers do.
    """
    return float(np.sqrt(max(squared, _SHARPEST**2)) ** (numbers / (numbers + _FIRM)))


def _ascended(variances: Array, score: Array, fisher: Array, least: Array) -> Array:
    """Variances one step of Fisher scoring up the likelihood, none of them below the least."""
    # Of two sensors alone only the sum is known: what the scatter does not tell stays.
    firm = fisher + np.diag(_INERT * np.diag(fisher) + np.finfo(float).tiny)
    root = np.linalg.cholesky(firm).T
    above, _ = nnls(root, root @ (variances - least) + np.linalg.solve(root.T, score))
    return np.asarray(least + above)


def wrong_views(
    bundle: Bundle, system: System, spreads: Sequence[Array], first: int = 0
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
        squared, freedom = misfit(at.information, F @ np.swapaxes(F, -1, -2), at.gradient)
        excess[k] = squared / chdtri(np.maximum(freedom, 1), _CHANCE)
        worst[views.board] = np.maximum(worst[views.board], excess[k])
    limit = max(1.0, _WAITING * worst.max(initial=0.0))
    return [
        np.asarray((over > limit) & (over >= worst[views.board]), dtype=np.bool_)
        for views, over in zip(bundle.all_views, excess, strict=True)
    ]

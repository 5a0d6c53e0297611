"""How large errors are, told from their scatter: of measurements, of whole views; and which views are wrong."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.refinement.rig.bundle import Bundle, Solved, System, ViewEquations
from calgraph.refinement.rig.normal_equations import huber_scatter, misfit, whitening
from calgraph.refinement.rig.views import relative

# Noise that has changed by less than this share has not changed.
_SAME = 5e-3
# How firmly the stated noise is believed, in measured numbers: it is off by a factor of 1.5, more or less.
_FIRM = 3
# Measurements are never taken to be more precise than this share of what is stated.
_SHARPEST = 0.01
# By which share of its Fisher information each sway holds on to what it is.
_INERT = 0.01
# A view is wrong if it is as far from the others as chance would have it once in so many.
_CHANCE = 1e-5
# Views less wrong than this share of the worst wait until that is left out.
_WAITING = 0.25


def with_measured_noise(bundle: Bundle, solved: Solved, spreads: Sequence[Array], first: int = 0) -> Bundle:
    """The bundle with each sensor's noise as its measurements scatter: in each view, and with the views.

    In a view, they scatter about the board that fits it best. Where views have few measurements, as where a line
    of a scan leaves a sheet twice, that tells little: their gradients have the covariance ``W`` of
    :func:`with_measured_sway`, and so scatter with the noise, too. Their sum of squares is set against what is
    expected of it, a step towards the largest restricted likelihood.

    Source: Förstner, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten", Allgemeine
    Vermessungs-Nachrichten 1979.

    Args:
        bundle: sensors' and outlines' views.
        solved: its solution.
        spreads: (K,) as of :func:`calgraph.refinement.rig.bundle.view_spreads`.
        first: of the views to measure; those before it keep their noise.
    """
    state, system, views = solved.state, solved.system, list(bundle.all_views[:first])
    for k, own in enumerate(bundle.all_views[first:], start=first):
        sums, at = system.visits[k].sums, system.views[k]
        squares, freedom = sums.scatter()
        whiten, _ = whitening(sums.core)
        between = np.sum((whiten @ at.gradient[..., None]) ** 2)
        expected = np.trace(whiten @ _scatter(at, spreads[k]) @ np.swapaxes(whiten, -1, -2), axis1=-2, axis2=-1)
        squared = (squares.sum() / huber_scatter(own.numbers) + between) * own.scale**2
        scale = _scale(squared, float(freedom.sum() + expected.sum()))
        T_sensor_board = relative(state.T_root_sensor[bundle.seer(k)], state.T_root_board[own.board])
        views.append(own if abs(scale / own.scale - 1) < _SAME else own.weighed(T_sensor_board, scale))
    return bundle.with_views(views)


def _scale(squared: float, numbers: float) -> float:
    """How many times larger than stated noise is, told by a sum of squares of so many numbers.

    What is stated is off by a factor, if it is: logarithms are averaged. In a mean of squares, one stated ten
    times too large would count as a hundred numbers do.
    """
    measured = max(squared / max(numbers, 1.0), _SHARPEST**2)
    return float(np.sqrt(measured) ** (numbers / (numbers + _FIRM)))


def _scatter(at: ViewEquations, spread: Array) -> Array:
    """Covariance ``A - A P A`` (V, q, q) of views' gradients, if ``spread`` (V, q, r) has the factors of ``P``."""
    Y = at.information @ spread
    return np.asarray(at.information - Y @ np.swapaxes(Y, -1, -2))


def with_measured_sway(bundle: Bundle, system: System, spreads: Sequence[Array], first: int = 0) -> Bundle:
    """The bundle with all sensors' and outlines' sway one step nearer to what the scatter of their views says.

    Fisher scoring of the restricted likelihood: views' gradients have the covariance ``W = A - A P A`` if noise
    and sway are right. Views of one board explain each other's scatter, so sensors are scored together; that of
    different boards goes together only as far as sensors are uncertain, and is left out.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
    1971.

    Args:
        bundle: sensors' and outlines' views.
        system: their equations at the solution.
        spreads: (K,) as of :func:`calgraph.refinement.rig.bundle.view_spreads`.
        first: of those to measure; those before it keep their sway.
    """
    measured = range(first, len(bundle.sway))
    unit = replace(bundle, sway=np.ones_like(bundle.sway))
    view_of = np.full((len(bundle.sway), len(system.H_board)), -1)
    for s in measured:
        view_of[s, bundle.all_views[s].board] = np.arange(len(bundle.all_views[s].board))
    to_axes = {s: np.swapaxes(system.views[s].basis, -1, -2) for s in measured}
    pulls = {s: to_axes[s] @ system.views[s].information @ spreads[s] for s in measured}
    score, fisher = np.zeros(len(measured)), np.zeros((len(measured), len(measured)))
    for s in measured:
        shape, at = unit.swaying(s), system.views[s]
        W = to_axes[s] @ _scatter(at, spreads[s]) @ at.basis
        gradient = (to_axes[s] @ at.gradient[..., None])[..., 0]
        score[s - first] = shape @ (gradient**2 - np.diagonal(W, axis1=-2, axis2=-1)).sum(axis=0)
        fisher[s - first, s - first] = shape @ np.sum(W**2, axis=0) @ shape
        for t in range(first, s):
            i, j = view_of[[s, t]][:, np.all(view_of[[s, t]] >= 0, axis=0)]
            W = pulls[s][i] @ np.swapaxes(pulls[t][j], -1, -2)
            fisher[s - first, t - first] = fisher[t - first, s - first] = (
                shape @ np.sum(W**2, axis=0) @ unit.swaying(t)
            )
    return replace(bundle, sway=np.append(bundle.sway[:first], _ascended(bundle.sway[first:], score, fisher)))


def _ascended(variances: Array, score: Array, fisher: Array) -> Array:
    """Variances one step of Fisher scoring up the likelihood, none of them negative."""
    # Of two sensors alone only the sum is known: what the scatter does not tell stays.
    firm = fisher + np.diag(_INERT * np.diag(fisher) + np.finfo(float).tiny)
    root = np.linalg.cholesky(firm).T
    best, _ = nnls(root, root @ variances + np.linalg.solve(root.T, score))
    return np.asarray(best)


def wrong_views(
    bundle: Bundle, system: System, spreads: Sequence[Array], first: int = 0
) -> list[NDArray[np.bool_]]:
    """By sensor and outline, (V,) which views contradict the others: of a board the worst, which bends the others.

    Views that are far worse than the rest bend all sensors: those that are less wrong are judged without them.

    Args:
        bundle: sensors' and outlines' views.
        system: their equations at the solution.
        spreads: (K,) as of :func:`calgraph.refinement.rig.bundle.view_spreads`.
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

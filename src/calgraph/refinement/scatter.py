"""How large errors are, told from their scatter: of measurements, of whole views; and which views are wrong."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.refinement.bundle import Bundle, State, System, view_covariances
from calgraph.refinement.normal_equations import huber_scatter, misfit, summed
from calgraph.refinement.views import relative

# How firmly the stated noise is believed, in measured numbers.
_FIRM = 10
# A view is wrong if it is as far from the others as chance would have it once in so many.
_CHANCE = 1e-5


def with_measured_noise(bundle: Bundle, state: State) -> Bundle:
    """The bundle with each sensor's noise as its measurements scatter about the board that fits each view best."""
    views = []
    for s, own in enumerate(bundle.views):
        T_sensor_board = relative(state.T_root_sensor[s], state.T_root_board[own.board])
        rows = own.linearize(T_sensor_board, state.own[bundle.own(s)])
        squares, freedom = summed(rows, own.start).scatter()
        squared = squares.sum() / huber_scatter(rows.residual.shape[1]) * own.scale**2
        scale = float(np.sqrt((squared + _FIRM) / (freedom.sum() + _FIRM)))
        views.append(own.weighed(T_sensor_board, scale))
    return replace(bundle, views=tuple(views))


def with_measured_sway(bundle: Bundle, system: System) -> Bundle:
    """The bundle with each sensor's sway one step nearer to what the scatter of its views says.

    Fisher scoring of the restricted likelihood: views' gradients have the covariance ``A - A P A`` if noise and
    sway are right. Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are
    unequal", Biometrika 1971.
    """
    sway = bundle.sway.copy()
    sharing = max(sum(len(views.board) for views in bundle.views) / max(len(system.H_board), 1), 2.0)
    for s, (at, P) in enumerate(zip(system.views, view_covariances(bundle, system), strict=True)):
        shape = replace(bundle, sway=np.ones(len(sway))).swaying(s)
        W = at.information - at.information @ P @ at.information
        score = np.sum(shape * at.gradient**2) - np.sum(shape * np.diagonal(W, axis1=-2, axis2=-1))
        fisher = np.sum(shape[:, None] * W * np.swapaxes(W, -1, -2) * shape)
        # Views of one board explain each other's scatter: were each to take it all, they would overshoot together.
        step = (1 - 1 / sharing) * float(score / fisher) if fisher > 0 else 0.0
        sway[s] = max(sway[s] + step, 0.0)
    return replace(bundle, sway=sway)


def wrong_views(bundle: Bundle, system: System) -> list[NDArray[np.bool_]]:
    """By sensor, (V,) which views contradict the others: of a board only the worst, for it bends the others."""
    boards = len(system.H_board)
    excess, covariances = [], view_covariances(bundle, system)
    worst: Array = np.zeros(boards)
    for views, at, P in zip(bundle.views, system.views, covariances, strict=True):
        squared, freedom = misfit(at.information, P, at.gradient)
        over = squared / chdtri(np.maximum(freedom, 1), _CHANCE)
        excess.append(over)
        worst[views.board] = np.maximum(worst[views.board], over)
    return [
        np.asarray((over > 1) & (over >= worst[views.board]), dtype=np.bool_)
        for views, over in zip(bundle.views, excess, strict=True)
    ]

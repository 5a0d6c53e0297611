"""Information and gradient of each board on the parameters: the terms of the reduced normal equations."""

import numpy as np

from calgraph.geometry import Array, se_n
from calgraph.rig.bundle.bundle_solver import BOARD_PRIOR_INFORMATION, Bundle, BundleEquations


def information_by_board(bundle: Bundle, equations: BundleEquations) -> Array:
    """(C, G, G) information of each board's views on the parameters, the board's pose eliminated.

    The reduced matrix is their sum and that of the priors.
    """
    H = np.zeros((len(equations.H_board), bundle.parameter_count, bundle.parameter_count))
    for k, (views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        columns, J = bundle.columns(k), at.J_sensor
        H[np.ix_(views.board, columns, columns)] += se_n.transpose(J) @ at.information @ J
    K = np.linalg.solve(equations.H_board + BOARD_PRIOR_INFORMATION * np.eye(6), equations.H_board_sensor)
    return np.asarray(H - se_n.transpose(equations.H_board_sensor) @ K)


def gradient_by_board(bundle: Bundle, equations: BundleEquations) -> Array:
    """(C, G) gradient of the cost of each board's views by the parameters, the board's pose eliminated.

    The reduced gradient is their sum and that of the priors.
    """
    g = np.zeros((len(equations.H_board), bundle.parameter_count))
    for k, (views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        J = se_n.transpose(at.J_sensor)
        g[np.ix_(views.board, bundle.columns(k))] += (J @ at.gradient[..., None])[..., 0]
    H_board = equations.H_board + BOARD_PRIOR_INFORMATION * np.eye(6)
    step = np.linalg.solve(H_board, equations.g_board[..., None])
    return np.asarray(g - (se_n.transpose(equations.H_board_sensor) @ step)[..., 0])

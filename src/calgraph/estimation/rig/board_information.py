"""What each board says of the sensors: the terms that a bundle's reduced problem is the sum of."""

import numpy as np

from calgraph.estimation.rig.bundle_solver import BOARD_PRIOR_INFORMATION, Bundle, BundleEquations
from calgraph.geometry import Array


def information_by_board(bundle: Bundle, system: BundleEquations) -> Array:
    """(C, G, G) information of each board's views on the sensors, the board's own pose eliminated.

    Their sum, and that of the priors, is what the reduced problem is made of.
    """
    H = np.zeros((len(system.H_board), bundle.parameter_count, bundle.parameter_count))
    for k, (views, at) in enumerate(zip(bundle.all_views, system.views, strict=True)):
        columns, G = bundle.columns(k), at.J_sensor
        H[np.ix_(views.board, columns, columns)] += np.swapaxes(G, -1, -2) @ at.information @ G
    K = np.linalg.solve(system.H_board + BOARD_PRIOR_INFORMATION * np.eye(6), system.H_board_sensor)
    return np.asarray(H - np.swapaxes(system.H_board_sensor, -1, -2) @ K)

"""What each board says of the sensors: the terms that a bundle's reduced problem is the sum of."""

import numpy as np

from calgraph.estimation.rig.bundle_solver import FAINT, Bundle, System
from calgraph.geometry import Array


def board_shares(bundle: Bundle, system: System) -> Array:
    """(C, G, G) information of each board's views on the sensors, the board's own pose eliminated.

    Their sum, and that of the priors, is what the reduced problem is made of.
    """
    H = np.zeros((len(system.H_board), bundle.size, bundle.size))
    for k, (views, at) in enumerate(zip(bundle.all_views, system.views, strict=True)):
        columns, G = bundle.columns(k), at.by_sensor
        H[np.ix_(views.board, columns, columns)] += np.swapaxes(G, -1, -2) @ at.information @ G
    K = np.linalg.solve(system.H_board + FAINT * np.eye(6), system.coupling)
    return np.asarray(H - np.swapaxes(system.coupling, -1, -2) @ K)

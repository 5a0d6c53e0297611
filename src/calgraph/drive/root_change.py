"""Poses and clocks of the joint solution against another sensor than the one that it was solved for."""

from dataclasses import replace

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.geometry import se_n


def change_root(adjusted: Adjustment, root: int) -> Adjustment:
    """The states of all sensors with another root, which is first, and their covariance; without parts.

    Args:
        adjusted: the solution; its first sensor is the root.
        root: number of the new one, whose pose is free in all axes.
    """
    S, columns = adjusted.free.shape
    n = len(adjusted.states[root].T_root_sensor) - 1
    p = n * (n + 1) // 2
    order = [root, *(k for k in range(S) if k != root)]
    of_root = adjusted.states[root]
    T_new = se_n.inverse(of_root.T_root_sensor)
    # Errors of the new parameters by those of the old ones; the old root gets the place of the new one.
    J = np.zeros((S, columns, S, columns))
    for row, k in enumerate(order):
        by_root, by_own = se_n.relative_pose_jacobians(of_root.T_root_sensor, adjusted.states[k].T_root_sensor)
        J[row, p:, k, p:] = np.eye(columns - p)
        J[row, :p, k, :p] = by_own
        J[row, :p, root, :p] += by_root
        J[row, p, root, p] -= 1.0
    free = adjusted.free.copy()
    free[[0, root], : p + 1] = free[[root, 0], : p + 1]
    free = free[order]
    J = J.reshape(free.size, free.size)[np.ix_(free.ravel(), adjusted.free.ravel())]
    return replace(
        adjusted,
        states=[
            replace(
                adjusted.states[k],
                T_root_sensor=T_new @ adjusted.states[k].T_root_sensor,
                clock_offset=adjusted.states[k].clock_offset - of_root.clock_offset,
            )
            for k in order
        ],
        parts=[],
        associations=[],
        responses=[],
        covariance=J @ adjusted.covariance @ J.T,
        independent_covariance=J @ adjusted.independent_covariance @ J.T,
        free=free,
        agreement=adjusted.agreement[np.ix_(order, order)],
        noise=replace(adjusted.noise, white=adjusted.noise.white[order]),
        point_counts=adjusted.point_counts[order],
    )

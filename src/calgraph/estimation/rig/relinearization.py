"""Sums over views whose measurements are looked at one by one now and then, and that are moved along in between.

A scanner's views have a hundred thousand beams, and a solver asks at a dozen states what they say. Near a state
where all were looked at, the sums tell it: ranges are almost linear in the board's plane, corners and outlines in
its pose.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.estimation.rig.normal_equations import ViewNormalEquations, accumulate_biased
from calgraph.estimation.rig.observations import BoardViews
from calgraph.geometry import Array, Index

# Sums are moved as long as, in every view, measurements change by less than this, root mean square, in standard
# deviations,
_MAX_RESIDUAL_CHANGE = 0.3
# and the board turns by less than this, rad.
_MAX_ROTATION = 0.01


@dataclass(frozen=True, eq=False)
class CachedLinearization:
    """What one sensor's views say where their measurements were looked at."""

    T_sensor_board: Array
    """(V, 4, 4)."""
    extra: Array
    """(e,) the sensor's own unknowns."""
    equations: ViewNormalEquations

    def extrapolate(self, views: BoardViews, T_sensor_board: Array, own: Array) -> ViewNormalEquations | None:
        """The sums at other poses (V, 4, 4) and own unknowns (e,); None if that is too far away."""
        cosine = np.sum(self.T_sensor_board[:, :3, 2] * T_sensor_board[:, :3, 2], axis=-1)
        change = views.local_difference(self.T_sensor_board, T_sensor_board, own - self.extra)
        near = (
            self.equations.squared_change(change) <= _MAX_RESIDUAL_CHANGE**2 * self.equations.residual_count
        ) & (cosine >= 1 - _MAX_ROTATION**2 / 2)
        return self.equations.extrapolate(change, views.local_jacobian(T_sensor_board)) if np.all(near) else None

    def select(self, keep: NDArray[np.bool_] | Index) -> "CachedLinearization":
        """The visit of some of the views: a mask (V,), or their numbers, which may repeat."""
        return CachedLinearization(self.T_sensor_board[keep], self.extra, self.equations.select(keep))


def linearize_views(views: BoardViews, T_sensor_board: Array, own: Array, sway: Array) -> CachedLinearization:
    """Looks at every measurement of the views.

    Args:
        views: of one sensor.
        T_sensor_board: (V, 4, 4) where.
        own: (e,) the sensor's own unknowns.
        sway: (6 + e,) variances of the displacement of one view, along the sensor's axes.
    """
    rows = views.linearize(T_sensor_board, own)
    return CachedLinearization(T_sensor_board, own, accumulate_biased(rows, views.start, sway))

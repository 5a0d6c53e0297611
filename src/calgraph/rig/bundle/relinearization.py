"""Normal equations of views that are extrapolated near the state of their last linearization.

A scanner's views have a hundred thousand beams, and a solver evaluates a dozen states. Near a linearization,
first-order extrapolation is accurate: ranges are almost linear in the board's plane, corners and outlines in its
pose.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.rig.bundle.normal_equations import ViewNormalEquations, accumulate_biased
from calgraph.rig.bundle.observations import BoardViews

# Maximum root mean square change of the residuals of any view, in standard deviations: the error is of second
# order in it. 0 linearizes at every state.
_MAX_RESIDUAL_CHANGE = 0.3
# Maximum rotation of a board, rad (0.6°): ranges change by its square, 1e-4, beyond first order.
_MAX_ROTATION = 0.01


@dataclass(frozen=True, eq=False)
class CachedLinearization:
    """One sensor's views, linearized at one state."""

    T_sensor_board: Array
    """(V, 4, 4)."""
    extra: Array
    """(e,) the sensor's extra parameters."""
    equations: ViewNormalEquations

    def extrapolate(self, views: BoardViews, T_sensor_board: Array, extra: Array) -> ViewNormalEquations | None:
        """The equations at other poses (V, 4, 4) and extra parameters (e,); None beyond the limits."""
        if not views.is_defined(T_sensor_board, extra):
            return None
        cosine = np.sum(self.T_sensor_board[:, :3, 2] * T_sensor_board[:, :3, 2], axis=-1)
        change = views.local_difference(self.T_sensor_board, T_sensor_board, extra - self.extra)
        squared, count = self.equations.squared_change(change), self.equations.residual_count
        near = squared <= _MAX_RESIDUAL_CHANGE**2 * count
        if not np.all(near & (cosine >= np.cos(_MAX_ROTATION))):
            return None
        return self.equations.extrapolate(change, views.local_jacobian(T_sensor_board))

    def select(self, keep: NDArray[np.bool_] | Index) -> "CachedLinearization":
        """That of some of the views: a mask (V,), or indices, which may repeat."""
        return CachedLinearization(self.T_sensor_board[keep], self.extra, self.equations.select(keep))


def linearize_views(
    views: BoardViews, T_sensor_board: Array, extra: Array, bias_variance: Array, huber_threshold: float
) -> CachedLinearization:
    """Linearizes every measurement of one sensor's views.

    Args:
        views: of one sensor.
        T_sensor_board: (V, 4, 4) the state.
        extra: (e,) the sensor's extra parameters.
        bias_variance: (8,) variances of a view's bias, as of :meth:`Bundle.bias_variances`.
        huber_threshold: of whitened residuals.
    """
    residuals = views.linearize(T_sensor_board, extra)
    equations = accumulate_biased(residuals, views.start, bias_variance, huber_threshold)
    return CachedLinearization(T_sensor_board, extra, equations)

"""Linearizations of a sensor's views: computed, extrapolated to states nearby, and weighed against each other."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array, Index
from calgraph.rig.bundle.normal_equations import BiasVariances, ViewNormalEquations, accumulate
from calgraph.rig.bundle.observations import BoardViews

# A scanner's views have a hundred thousand beams, and a solver evaluates a dozen states. Near the state of the
# last linearization, first-order extrapolation is accurate: ranges are almost linear in the board's plane,
# corners and outlines in its pose.

# Maximum root mean square change of the residuals of any view, in standard deviations: the error is of second
# order in it. 0 linearizes at every state.
_MAX_RESIDUAL_CHANGE = 0.3
# Maximum rotation of a board, rad (0.6°): ranges change by its square, 1e-4, beyond first order.
_MAX_ROTATION = 0.01
# Probability that a correct view deviates from the others by more than a limit: with 1,000 views, one recording in
# 100 loses one.
OUTLIER_SIGNIFICANCE = 1e-5


@dataclass(frozen=True, eq=False)
class CachedLinearization:
    """One sensor's views, linearized at one state."""

    T_sensor_board: Array
    """(V, 4, 4)."""
    extra: Array
    """(e,) the sensor's extra parameters."""
    equations: ViewNormalEquations

    def weigh_views(self, at: ViewNormalEquations, costs: Array) -> tuple[Array, Array]:
        """Weights (V,) of views, and their robust costs (V,): beyond a limit, linear in the deviation.

        The deviation of a view is that of its best fit from the boards and sensors, in standard deviations with
        its bias. Source: Huber, "Robust statistics", 1981, section 7.6.

        Args:
            at: the equations, extrapolated from these.
            costs: (V,) with the biases marginalised.
        """
        if not np.isfinite(self.equations.JtJ).all():
            # A step took a board behind a camera: the solver refuses infinite costs.
            return np.ones_like(costs), costs
        scatter, freedom = self._scatter
        limit = chdtri(np.maximum(at.residual_count - freedom, 1), OUTLIER_SIGNIFICANCE)
        squared = 2 * (costs - at.robust_cost_offset) - scatter
        weight = np.sqrt(limit / np.maximum(squared, limit))
        return weight, costs - 0.5 * limit * (1 / weight - 1) ** 2

    @cached_property
    def _scatter(self) -> tuple[Array, Index]:
        """See :meth:`ViewNormalEquations.within_view_scatter`: extrapolation does not change it."""
        return self.equations.within_view_scatter()

    def extrapolate(self, views: BoardViews, T_sensor_board: Array, extra: Array) -> ViewNormalEquations | None:
        """The equations at other poses (V, 4, 4) and extra parameters (e,); None beyond the limits.

        Whether residuals are defined there is not asked: a solver does so where it ends.
        """
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
    views: BoardViews, T_sensor_board: Array, extra: Array, bias: BiasVariances, huber_threshold: float
) -> CachedLinearization:
    """Linearizes every measurement of one sensor's views.

    Args:
        views: of one sensor.
        T_sensor_board: (V, 4, 4) the state.
        extra: (e,) the sensor's extra parameters.
        bias: variances of the views' biases.
        huber_threshold: of whitened residuals.
    """
    residuals = views.linearize(T_sensor_board, extra)
    equations = accumulate(residuals, views.start, huber_threshold, lambda found: found.estimate_bias(bias))
    return CachedLinearization(T_sensor_board, extra, equations)

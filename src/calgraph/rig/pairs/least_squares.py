"""Batched small least squares on SE(3) in which unobservable directions keep their start values."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.solver.levenberg_marquardt import DenseLinearization, minimize_batch

# Relative decrease of the cost at which a problem has converged; initial damping: many starts are far from a
# minimum.
_TOLERANCE, _INITIAL_DAMPING = 1e-9, 1e-4


def gauss_newton(
    T: Array, residuals: Callable[[Array], tuple[Array, Array]], min_rms_slope: float, iterations: int
) -> tuple[Array, Array]:
    """Minimizes K independent sums of squares over poses.

    Args:
        T: (K, 4, 4) start values.
        residuals: poses (K, 4, 4) to residuals (K, m) and their Jacobians (K, m, 6) for se3.retract; NaN for
            infeasible poses, to which no step is taken.
        min_rms_slope: change of the residuals' RMS per unit of a direction (m or rad) below which it keeps its
            start value.
        iterations: maximum number of steps.

    Returns:
        The poses (K, 4, 4) and their mean squared residuals (K,), infinite for infeasible start values.
    """

    def linearize(T: Array) -> _PoseLinearization:
        r, J = residuals(T)
        root = np.sqrt(r.shape[1])
        return _PoseLinearization(r / root, np.nan_to_num(J) / root, min_rms_slope)

    T, at = minimize_batch(
        T, linearize, se3.retract,
        iterations=iterations, relative_tolerance=_TOLERANCE, damping=_INITIAL_DAMPING,
    )  # fmt: skip
    return T, np.where(np.isnan(at.cost), np.inf, 2 * at.cost)


@dataclass(frozen=True, eq=False)
class _PoseLinearization(DenseLinearization):
    """Residuals of K problems, whose sum of squares is their mean square."""

    min_rms_slope: float

    def solve(self, damping: Array) -> tuple[Array, Array]:
        """Steps (K, 6) along the observable directions, and predicted decreases (K,)."""
        values, vectors = np.linalg.eigh(self.information)
        slope = (self.gradient[:, None] @ vectors)[:, 0]
        observable = values > self.min_rms_slope**2
        step = np.where(observable, slope / (values + damping[:, None]), 0.0)
        decrease = np.where(observable, step * (slope - 0.5 * values * step), 0.0)
        return -(vectors @ step[..., None])[..., 0], decrease.sum(axis=1)


def axis_aligned_rotations() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes: start values for sensors of unknown mounting."""
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                rotations.append(R)
    return np.array(rotations)

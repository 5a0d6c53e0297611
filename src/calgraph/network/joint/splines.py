"""Smooth curves in time: uniform cubic B-splines (de Boor, "A practical guide to splines", 2001, chapter X)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# The four cubic basis functions that are not zero between two knots: row k holds the coefficients of 1, u, u², u³.
_BASIS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
_BASIS_DERIVATIVE = np.array([[-3, 6, -3], [0, -12, 9], [3, 6, -9], [0, 0, 3]]) / 6


@dataclass(frozen=True)
class Knots:
    """Equidistant knots; a curve's value at any time is a weighted mean of four of its control points."""

    start: float
    """s."""
    step: float
    """s."""
    count: int
    """Number of control points, at least 4."""

    @classmethod
    def spanning(cls, start: float, end: float, step: float) -> "Knots":
        """Knots for curves from ``start`` to ``end``, every ``step``; all in s."""
        return cls(start, step, max(int(np.ceil((end - start) / step)), 1) + 3)

    def basis_at(self, times: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Basis functions at times (N,), s.

        Returns:
            The first of the four control points (N,), their weights (N, 4), and their weights in the derivative
            (N, 4), 1/s.
        """
        position = (times - self.start) / self.step
        first = np.clip(np.floor(position).astype(np.intp), 0, self.count - 4)
        u = position - first
        powers = np.stack([np.ones_like(u), u, u * u, u**3], axis=-1)
        return first, np.asarray(powers @ _BASIS.T), np.asarray(powers[:, :3] @ _BASIS_DERIVATIVE.T / self.step)

    @property
    def duration(self) -> float:
        """Of the curve, s."""
        return self.step * (self.count - 3)

    def control_times(self) -> Array:
        """(count,) the times at which the weights of the control points are greatest, s."""
        return np.asarray(self.start + self.step * (np.arange(self.count) - 1.0), dtype=np.float64)


def evaluate_spline(control: Array, first: NDArray[np.intp], weights: Array) -> Array:
    """Values (N, d) of a curve with control points (K, d), for weights of :meth:`Knots.basis_at`."""
    return np.asarray(np.einsum("nk,nkd->nd", weights, control[first[:, None] + np.arange(4)]))

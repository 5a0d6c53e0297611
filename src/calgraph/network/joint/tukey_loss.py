"""Tukey's biweight loss, with the expectations that relate its weights to information."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calgraph.geometry import Array

# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


@dataclass(frozen=True)
class TukeyLoss:
    """The biweight of Beaton and Tukey (1974): residuals beyond the limit have no weight.

    Expectations are over standard normal residuals ``r`` with weights ``w(r) = (1 - r²/c²)²`` and the score
    ``ψ(r) = w(r) r``.
    """

    limit: float
    """c, standard deviations."""

    @cached_property
    def _expected_weight(self) -> float:
        """E[w]."""
        return self._expect([1, 0, -2, 0, 1])

    @cached_property
    def _expected_score_derivative(self) -> float:
        """E[ψ']."""
        return self._expect([1, 0, -6, 0, 5])

    @cached_property
    def _expected_squared_score(self) -> float:
        """E[ψ²]."""
        return self.limit**2 * self._expect([0, 0, 1, 0, -4, 0, 6, 0, -4, 0, 1])

    @cached_property
    def _scale(self) -> float:
        """Makes the sum of weights the information ``E[ψ']² / E[ψ²]`` of the beams (Huber, 1981), not ``E[w]``."""
        return self._expected_score_derivative**2 / (self._expected_squared_score * self._expected_weight)

    @property
    def mean_weight(self) -> float:
        """Expected scaled weight."""
        return self._scale * self._expected_weight

    @property
    def score_to_information(self) -> float:
        """Expected square of a scaled score, as a multiple of the information in the scaled weights."""
        return self._scale * self._expected_squared_score / self._expected_weight

    @property
    def median_shrinkage(self) -> float:
        """By how much the median absolute residual shrinks per leverage of the residuals on a fitted model.

        It is the effect of a measurement on its prediction, less the noise that the others add to it.
        """
        effect = (1 - (_MEDIAN / self.limit) ** 2) ** 2 / self._expected_score_derivative
        return effect - self._expected_squared_score / self._expected_score_derivative**2 / 2

    def compute_weights(self, residual: Array, used: NDArray[np.bool_], near_side_factor: float = 1.0) -> Array:
        """(N,) scaled weights, whose sum is the information of the residuals.

        Args:
            residual: (N,) whitened, positive for beams that end in front of the outline.
            used: (N,) whether a residual has a weight at all.
            near_side_factor: by how much the limit is lower for positive residuals.
        """
        ratio = np.where(residual > 0, residual * near_side_factor, residual) / self.limit
        return np.asarray(self._scale * used * np.maximum(1 - ratio**2, 0) ** 2)

    def _expect(self, coefficients: list[float]) -> float:
        """Expectation of a polynomial in ``r / c`` within the limit, by the moments of the truncated normal."""
        c = self.limit
        density = np.exp(-(c**2) / 2) / np.sqrt(2 * np.pi)
        moments = [float(erf(c / np.sqrt(2))), 0.0]
        for k in range(2, len(coefficients)):
            moments.append((k - 1) * moments[k - 2] - (2 * c ** (k - 1) * density if k % 2 == 0 else 0.0))
        return float(sum(a * m / c**k for k, (a, m) in enumerate(zip(coefficients, moments, strict=False))))

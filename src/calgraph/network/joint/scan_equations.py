"""Normal equations of a body's pose and radii and of errors of beams, summed over the beams of each scan.

People are not ellipses on smooth curves: arms swing, shoulders turn. These errors are common to all beams of a
scan, so that more beams do not average them. Each scan therefore has an unknown displacement of the body's pose
with a given variance, which is marginalised.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calgraph.geometry import Array, Index, select_rows
from calgraph.solver.marginalization import marginalize_independent_biases


@dataclass(frozen=True, eq=False)
class ScanEquations:
    """Normal equations of V scans.

    The P parameters of each are the body's pose (3) and outline (O), an error of all ranges (m), the angle scale
    and the two stretches.
    """

    information: Array
    """(V, P, P)."""
    gradient: Array
    """(V, P)."""
    cost: Array
    """(V,) half the sum of squared whitened residuals."""

    def marginalize_model_error(self, variance: Array) -> "ScanEquations":
        """The equations with a displacement of the pose in each scan, of variances (3,), marginalised."""
        return ScanEquations(*marginalize_independent_biases(self.information, self.gradient, self.cost, variance))


@dataclass(frozen=True, eq=False)
class ScanTerms:
    """What V scans of one scanner contribute to the normal equations of a body."""

    place: int
    """Of the scanner among those that measured the body."""
    first: Index
    """(V,) the first of the four control points that each scan depends on, ascending."""
    weights: Array
    """(V, 4) of these control points."""
    equations: ScanEquations
    scanner_jacobian: Array
    """(V, P, U) of the parameters, relative to the scanner, by the scanner's unknowns."""
    shape_rows: slice
    """Those of the P parameters that are unknowns of the body's shape."""
    shape_columns: Index
    """Their places among all unknowns of its shape."""

    def select(self, scans: slice) -> "ScanTerms":
        """Those of some scans."""
        return replace(
            self,
            first=self.first[scans],
            weights=self.weights[scans],
            equations=select_rows(self.equations, scans),
            scanner_jacobian=self.scanner_jacobian[scans],
        )


def sum_over_scans(residual: Array, jacobian: Array, weight: Array, first_beam: Index) -> ScanEquations:
    """Sums the normal equations of beams over scans.

    Args:
        residual: (N,) whitened.
        jacobian: (P, N) whitened.
        weight: (N,).
        first_beam: (V,) the first beam of each scan.
    """
    rows = np.concatenate([jacobian, residual[None]])
    weighted = weight * rows
    total = np.empty((len(rows), len(rows), len(first_beam)))
    # One row at a time over all beams: scans have few beams, and there are many scans.
    for i, row in enumerate(weighted):
        total[i, i:] = total[i:, i] = np.add.reduceat(row * rows[i:], first_beam, axis=1)
    total = np.moveaxis(total, -1, 0)
    return ScanEquations(total[:, :-1, :-1], total[:, :-1, -1], 0.5 * total[:, -1, -1])


# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


# Limit of Tukey's biweight, standard deviations. The textbook's 4.685 has an efficiency of 95 % for Gaussian
# noise, this one 64 %, but the former takes swinging arms for the torso.
TUKEY_LIMIT = 2.5


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

"""From beams to what each scan of a body says: weighed, summed, and allowed to see the body a little off its path.

Bodies are no ellipses on smooth curves: arms swing, shoulders turn. The beams of one scan then err together, and
however many there are, they say no more of the path than the body keeps to it. So each scan may see its body
displaced by an unknown of its own, which is marginalised.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index

# Beams farther off than so many standard deviations are of arms, or of somebody else (Beaton and Tukey, 1974). The
# textbook's 4.685 would lose less of Gaussian noise, but takes arms that swing by for the torso.
_TUKEY = 2.5
# Of normal residuals r with Tukey's weights w, which pull by ψ = w r: means of w, of the derivative ψ', and of ψ².
_WEIGHT, _SLOPE, _PULL2 = 0.755, 0.399, 0.248
# Estimates scatter as if a beam told E[ψ']² / E[ψ²] of what its noise says (Huber, 1981), which is less than E[w].
_INFORMED = _SLOPE**2 / (_PULL2 * _WEIGHT)
# Squared pulls of beams over the information that is in their weights.
PULLED = _INFORMED * _PULL2 / _WEIGHT
# What normal beams count on average.
COUNTED = _INFORMED * _WEIGHT
# The median of normal residuals, without sign. Where beams have a leverage on what is fitted to them, it becomes
# smaller by so many times that leverage: by what a beam pulls there itself, less what the noise of others adds.
_MEDIAN = 0.6745
SHRUNK = (1 - (_MEDIAN / _TUKEY) ** 2) ** 2 / _SLOPE - _PULL2 / _SLOPE**2 / 2
# Numbers that a beam's range depends on: the body's pose and its radii.
_ROWS, _COLUMNS = np.triu_indices(6)
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, eq=False)
class Scans:
    """What V scans say of a body's pose and radii."""

    information: Array
    """(V, 5, 5)."""
    gradient: Array
    """(V, 5)."""
    cost: Array
    """(V,) half squared standard deviations."""

    def swayed(self, sway: Array) -> "Scans":
        """The same if each scan saw the body's pose displaced by an unknown of its own, with variances (3,) Q.

        Marginalising it leaves ``A - A (Q⁻¹ + A)⁻¹ A``, and ``b - A (Q⁻¹ + A)⁻¹ b``.
        """
        A, b = self.information, self.gradient
        inverse = self._displaced(sway)
        gain, shift = A[:, :, :3] @ inverse, inverse @ b[:, :3, None]
        return Scans(
            A - gain @ A[:, :3],
            b - (A[:, :, :3] @ shift)[..., 0],
            self.cost - 0.5 * np.sum(b[:, :3] * shift[..., 0], axis=-1),
        )

    def _displaced(self, sway: Array) -> Array:
        """(V, 3, 3) covariance of the displacement, the path being as it is."""
        return _inverse3(self.information[:, :3, :3] + np.diag(1 / sway))


def summed(residual: Array, jacobian: Array, weight: Array, start: Index) -> Scans:
    """Sums whitened residuals (N,), jacobians (N, 5) and weights (N,) over scans that begin at ``start`` (V,)."""
    rows = np.concatenate([jacobian.T, residual[None]])
    weighted = weight * rows
    # One product of numbers after the other, all beams at once: scans are short, and there are many.
    products = [np.add.reduceat(weighted[i] * rows[j], start) for i, j in zip(_ROWS, _COLUMNS, strict=True)]
    total = np.empty((len(start), 6, 6))
    total[:, _ROWS, _COLUMNS] = total[:, _COLUMNS, _ROWS] = np.stack(products, axis=1)
    return Scans(total[:, :5, :5], total[:, :5, 5], 0.5 * total[:, 5, 5])


def robust_weights(residual: Array, used: NDArray[np.bool_], before: float = 1.0) -> Array:
    """(N,) how much each beam counts: the less, the farther off, and nothing beyond what noise explains (Tukey).

    On average beams count as much as they tell, so that sums of weights are their information.

    Beams are judged about where the path has the body. Were each scan to say first where it sees the body, arms
    would pass for a body that is displaced.

    Args:
        residual: (N,) whitened, positive for beams that end before the outline.
        used: (N,) whether a beam counts at all.
        before: by how much nearer the limit is for beams that end before the outline than for those behind it.
    """
    off = np.where(residual > 0, residual * before, residual) / _TUKEY
    return np.asarray(_INFORMED * used * np.maximum(1 - off**2, 0) ** 2)


def _inverse3(A: Array) -> Array:
    """Inverses of symmetric (V, 3, 3) by cofactors, several times as fast as a decomposition."""
    a, b, c, d, e, f = A[:, _UPPER[0], _UPPER[1]].T
    cofactors = np.stack(
        [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    )
    cofactors /= a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    inverse = np.empty_like(A)
    inverse[:, _UPPER[0], _UPPER[1]] = inverse[:, _UPPER[1], _UPPER[0]] = cofactors.T
    return inverse

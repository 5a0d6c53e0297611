"""From measurements to the normal equations of views: outliers held off, common errors allowed for."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc, gammaln

from calgraph.geometry import Array, Index
from calgraph.refinement.rig.views import Rows

# Residuals beyond so many standard deviations count less (Huber): Gaussian noise loses 0.3 % of its information.
HUBER = 2.5
# Times at most that outliers of a view are judged anew about where it then is.
_REWEIGHTINGS = 3
# Directions of a view with less than this share of its information are not measured by it.
_RANK = 1e-10
# Directions of a view that the others check with less than this share of its weight are not checked.
_CHECKED = 1e-3


@dataclass(frozen=True, eq=False)
class ViewSums:
    """What V views say, summed over their measurements."""

    core: Array
    """(V, q, q) information on the q numbers that the measurements depend on."""
    slope: Array
    """(V, q) gradient by them."""
    basis: Array
    """(V, q, p): how they move with the pose and the sensor's own unknowns."""
    square: Array
    """(V,) weighted sum of squared residuals."""
    held: Array
    """(V,) what it costs to hold outliers off, in half squares: the robust cost is this and half of ``square``."""
    count: NDArray[np.intp]
    """(V,) how many numbers were measured."""

    @property
    def information(self) -> Array:
        """(V, p, p)."""
        return np.asarray(np.swapaxes(self.basis, -1, -2) @ self.core @ self.basis)

    @property
    def gradient(self) -> Array:
        """(V, p)."""
        return np.asarray((np.swapaxes(self.basis, -1, -2) @ self.slope[..., None])[..., 0])

    def scatter(self) -> tuple[Array, NDArray[np.intp]]:
        """Squared residuals (V,) about each view's own best fit, and how many numbers are left to scatter (V,).

        They tell the noise of single measurements, however wrong sensors and board are placed.
        """
        explained = np.einsum("vi,vij,vj->v", self.slope, _pseudo_inverse(self.core), self.slope)
        return self.square - explained, self.count - _rank(self.core)

    def fit(self) -> Array:
        """(V, q) by how much the numbers that measurements depend on are to change to fit each view best."""
        return np.asarray(-(_pseudo_inverse(self.core) @ self.slope[..., None])[..., 0])


def summed(rows: Rows, start: Index, fitted: Callable[[ViewSums], Array] = ViewSums.fit) -> ViewSums:
    """Sums rows over views, which start at ``start`` (V,).

    Which measurements are outliers is judged where each view itself would have its board: where it is displaced as
    a whole, all of its measurements are off, and none of them is wrong.

    Args:
        rows: of N measurements.
        start: (V,).
        fitted: (V, q) from sums, where the views are to be judged.
    """
    view = np.repeat(np.arange(len(start)), np.diff(start, append=len(rows.residual)))
    plain = sums = _plain_sums(rows, start)
    for _ in range(_REWEIGHTINGS):
        size = _sizes(_shifted(rows, start, fitted(sums)))
        outlying = np.flatnonzero(size > HUBER)
        if not len(outlying):
            break
        sums = _without_excess(plain, rows, outlying, view, size)
    return sums


def _plain_sums(rows: Rows, start: Index) -> ViewSums:
    """Sums in which all measurements count in full."""
    count, k, q = rows.jacobian.shape
    flat, residual = rows.jacobian.reshape(-1, q), rows.residual.ravel()
    core, slope, square = np.empty((len(start), q, q)), np.empty((len(start), q)), np.empty(len(start))
    for view, (first, last) in enumerate(pairwise(k * np.append(start, count))):
        # View by view: this is what BLAS is best at.
        J, r = flat[first:last], residual[first:last]
        core[view], slope[view], square[view] = J.T @ J, J.T @ r, r @ r
    return ViewSums(core, slope, rows.basis, square, np.zeros(len(start)), np.diff(start, append=count) * k)


def _shifted(rows: Rows, start: Index, shift: Array) -> Array:
    """Residuals (N, k) after the numbers that each view's measurements depend on have changed by (V, q)."""
    count, k, q = rows.jacobian.shape
    flat, shifted = rows.jacobian.reshape(-1, q), rows.residual.flatten()
    for change, (first, last) in zip(shift, pairwise(k * np.append(start, count)), strict=True):
        shifted[first:last] += flat[first:last] @ change
    return shifted.reshape(-1, k)


def _without_excess(sums: ViewSums, rows: Rows, outlying: Index, view: Index, size: Array) -> ViewSums:
    """The sums with M measurements weighed by ``HUBER / size`` instead of in full.

    Args:
        sums: in which all count in full.
        rows: of N measurements.
        outlying: (M,) which of them.
        view: (N,) of which view each is.
        size: (N,) how far off they are where they are judged.
    """
    excess, J, r = 1 - HUBER / size[outlying], rows.jacobian[outlying], rows.residual[outlying]
    Jt = excess[:, None, None] * np.swapaxes(J, -1, -2)
    core, slope, square, held = sums.core.copy(), sums.slope.copy(), sums.square.copy(), sums.held.copy()
    np.subtract.at(core, view[outlying], Jt @ J)
    np.subtract.at(slope, view[outlying], (Jt @ r[..., None])[..., 0])
    np.subtract.at(square, view[outlying], excess * np.sum(r**2, axis=-1))
    np.add.at(held, view[outlying], 0.5 * HUBER * (size[outlying] - HUBER))
    return replace(sums, core=core, slope=slope, square=square, held=held)


def _sizes(residual: Array) -> Array:
    """(N,) lengths of residuals (N, k)."""
    return np.linalg.norm(residual, axis=1) if residual.shape[1] > 1 else np.abs(residual[:, 0])


def swayed(rows: Rows, start: Index, sway: Array) -> tuple[Array, Array, Array]:
    """The views' information, gradients and costs if each saw its board displaced by an unknown of its own.

    A bent board, a range that is off for one material, a stamp that is late: measurements of one view then err
    together, and however many there are, they say no more than the displacement allows. It is marginalised:
    ``(A⁻¹ + Q)⁻¹ = (I + A Q)⁻¹ A``, and ``-Q b`` is the likeliest displacement.

    Args:
        rows: of N measurements.
        start: (V,) where views begin.
        sway: (p,) variances Q of the displacement along the sensor's axes; 0 for the sensor's own unknowns.

    Returns:
        (V, p, p), (V, p) and (V,).
    """

    def marginal(sums: ViewSums) -> tuple[Array, Array]:
        A, b = sums.information, sums.gradient
        shrink = np.linalg.inv(np.eye(len(sway)) + A * sway)
        return shrink @ A, (shrink @ b[..., None])[..., 0]

    def displaced(sums: ViewSums) -> Array:
        return np.asarray((sums.basis @ (-sway * marginal(sums)[1])[..., None])[..., 0])

    sums = summed(rows, start, displaced)
    A, b = marginal(sums)
    cost = sums.held + 0.5 * (sums.square - np.sum(sums.gradient * sway * b, axis=-1))
    return (A + np.swapaxes(A, -1, -2)) / 2, b, cost


def misfit(information: Array, spread: Array, gradient: Array) -> tuple[Array, NDArray[np.intp]]:
    """How badly views fit the solution that they are part of, for the covariance of what they say.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968.

    Args:
        information: (V, p, p) A of each view.
        spread: (V, p, p) covariance P of the solution where the view measures it, the view's own part included.
        gradient: (V, p) of each view at the solution; its covariance is A - A P A.

    Returns:
        Squared Mahalanobis distances (V,) of the gradients from zero, and their degrees of freedom (V,):
        directions that other views hardly check do not count.
    """
    unit, size = _normalised(information)
    values, vectors = np.linalg.eigh(unit)
    seen = values > _RANK * values[..., -1:]
    root = np.where(seen, values, 1.0) ** -0.5 * seen
    whiten = root[..., :, None] * np.swapaxes(vectors, -1, -2) / size[..., None, :]
    forced = whiten @ information
    redundancy = seen[..., :, None] * np.eye(values.shape[-1]) - forced @ spread @ np.swapaxes(forced, -1, -2)
    free, axes = np.linalg.eigh((redundancy + np.swapaxes(redundancy, -1, -2)) / 2)
    checked = free > _CHECKED
    along = (np.swapaxes(axes, -1, -2) @ whiten @ gradient[..., None])[..., 0]
    squared = np.sum(checked * along**2 / np.where(checked, free, 1.0), axis=-1)
    return squared, np.asarray(checked.sum(axis=-1), dtype=np.intp)


def huber_scatter(dimension: int) -> float:
    """Mean of ``weight * |r|²`` over its degrees of freedom, for Gaussian residuals ``r`` of so many numbers."""
    d, h = dimension, HUBER
    inside = d * chdtr(d + 2, h**2)
    outside = h * np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2)) * chdtrc(d + 1, h**2)
    return float((inside + outside) / d)


def _normalised(A: Array) -> tuple[Array, Array]:
    """Matrices with unit diagonal, so that metres and radians compare; and what they were divided by."""
    size = np.sqrt(np.maximum(np.diagonal(A, axis1=-2, axis2=-1), 0))
    size = np.where(size > 0, size, 1.0)
    return A / size[..., :, None] / size[..., None, :], size


def _pseudo_inverse(A: Array) -> Array:
    unit, size = _normalised(A)
    inverse = np.linalg.pinv(unit, rcond=_RANK, hermitian=True)
    return np.asarray(inverse / size[..., :, None] / size[..., None, :])


def _rank(A: Array) -> NDArray[np.intp]:
    unit, _ = _normalised(A)
    values = np.abs(np.linalg.eigvalsh(unit))
    return np.asarray(np.sum(values > _RANK * values[..., -1:], axis=-1), dtype=np.intp)

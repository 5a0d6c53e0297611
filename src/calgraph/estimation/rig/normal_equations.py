"""From measurements to the normal equations of views: outliers held off, common errors allowed for."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc, gammaln

from calgraph.estimation.rig.observations import Rows
from calgraph.geometry import Array, Index

# Residuals beyond so many standard deviations count less (Huber): Gaussian noise loses 0.3 % of its information.
HUBER = 2.5
# Times at most that outliers of a view are judged anew about where it then is.
_REWEIGHTINGS = 3
# They are not if that is where it was, to such a share of their standard deviations, root mean square.
_STEADY = 1e-2
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
        whiten, seen = whitening(self.core)
        explained = np.sum(_times(whiten, self.slope) ** 2, axis=-1)
        return self.square - explained, self.count - np.sum(seen, axis=-1)

    def fit(self) -> Array:
        """(V, q) by how much the numbers that measurements depend on are to change to fit each view best."""
        whiten, _ = whitening(self.core)
        return -_times(np.swapaxes(whiten, -1, -2), _times(whiten, self.slope))

    def where(self, keep: NDArray[np.bool_] | Index) -> "ViewSums":
        """Those of some of the views: a mask (V,), or their numbers, which may repeat."""
        return ViewSums(
            self.core[keep],
            self.slope[keep],
            self.basis[keep],
            self.square[keep],
            self.held[keep],
            self.count[keep],
        )

    def squared(self, change: Array) -> Array:
        """(V,) by how much residuals change, squared and summed, as the numbers do that they depend on (V, q)."""
        return np.asarray(np.einsum("vi,vij,vj->v", change, self.core, change))

    def moved(self, change: Array, basis: Array) -> "ViewSums":
        """The sums after the numbers that measurements depend on have changed by (V, q), to first order in these.

        Measurements keep the weights that they have; ``basis`` is the new one.
        """
        slope = self.slope + _times(self.core, change)
        square = self.square + np.sum(change * (self.slope + slope), axis=-1)
        return replace(self, slope=slope, square=square, basis=basis)

    def swayed(self, sway: Array) -> tuple[Array, Array, Array]:
        """The views' information, gradients and costs if each saw its board displaced by an unknown of its own.

        A bent board, a range that is off for one material, a stamp that is late: measurements of one view then err
        together, and however many there are, they say no more than the displacement allows. It is marginalised:
        what is left of A is ``(A⁻¹ + Q)⁻¹ = (I + A Q)⁻¹ A``.

        Args:
            sway: (p,) variances Q of the displacement along the sensor's axes; 0 for the sensor's own unknowns.

        Returns:
            (V, q, q), (V, q) and (V,).
        """
        if not np.any(sway):
            return self.core, self.slope, self.held + 0.5 * self.square
        spread = _spread(self.basis, sway)
        shrink = _shrink(self.core, spread)
        A, slope = shrink @ self.core, _times(shrink, self.slope)
        explained = np.sum(_times(spread, slope) * self.slope, axis=-1)
        return (A + np.swapaxes(A, -1, -2)) / 2, slope, self.held + 0.5 * (self.square - explained)

    def displaced(self, spread: Array) -> Array:
        """(V, q) the likeliest displacement, if it has the covariance ``spread`` (V, q, q)."""
        return -_times(spread @ _shrink(self.core, spread), self.slope)


def summed(rows: Rows, start: Index, fitted: Callable[[ViewSums], Array] = ViewSums.fit) -> ViewSums:
    """Sums rows over views, which start at ``start`` (V,).

    Which measurements are outliers is judged where each view itself would have its board: where it is displaced as
    a whole, all of its measurements are off, and none of them is wrong.

    Args:
        rows: of N measurements.
        start: (V,).
        fitted: (V, q) from sums, where the views are to be judged.
    """
    columns, residual = _columns(rows), rows.residual.ravel()
    count = np.diff(start, append=len(rows.residual)) * rows.residual.shape[1]
    plain = sums = _plain_sums(columns, residual, rows.basis, count)
    shift = fitted(sums)
    for _ in range(_REWEIGHTINGS):
        off = residual + np.einsum("in,in->n", columns, np.repeat(shift.T, count, axis=1))
        size = _sizes(off.reshape(rows.residual.shape))
        if not np.any(size > HUBER):
            return plain
        sums = _without_excess(plain, columns, residual, start, size)
        before, shift = shift, fitted(sums)
        if np.all(plain.squared(shift - before) <= _STEADY**2 * count):
            break
    return sums


def judged(rows: Rows, start: Index, sway: Array) -> ViewSums:
    """Sums rows over views, which start at ``start`` (V,): outliers are judged where each view likeliest sways."""
    spread = _spread(rows.basis, sway)
    return summed(rows, start, lambda sums: sums.displaced(spread))


def _columns(rows: Rows) -> Array:
    """(q, N·k) derivatives of all residuals, one number after the other in memory."""
    return np.ascontiguousarray(rows.jacobian.reshape(-1, rows.jacobian.shape[-1]).T)


def _plain_sums(columns: Array, residual: Array, basis: Array, count: Index) -> ViewSums:
    """Sums of derivatives (q, n) and residuals (n,), so many of each view, all of which count in full."""
    q = len(columns)
    core, slope = np.empty((len(count), q, q)), np.empty((len(count), q))
    for i in range(q):
        for j in range(i, q):
            core[:, i, j] = core[:, j, i] = _by_view(columns[i] * columns[j], count)
        slope[:, i] = _by_view(columns[i] * residual, count)
    return ViewSums(core, slope, basis, _by_view(residual**2, count), np.zeros(len(count)), count)


def _without_excess(plain: ViewSums, columns: Array, residual: Array, start: Index, size: Array) -> ViewSums:
    """The sums with outliers weighed by ``HUBER / size`` instead of in full.

    Args:
        plain: in which all count in full.
        columns: (q, N·k) derivatives.
        residual: (N·k,).
        start: (V,) where views begin.
        size: (N,) how far off measurements are where they are judged.
    """
    outlying = np.flatnonzero(size > HUBER)
    far, k = size[outlying], len(residual) // max(len(size), 1)
    count = np.bincount(np.searchsorted(start, outlying, side="right") - 1, minlength=len(start))
    numbers, root = (k * outlying[:, None] + np.arange(k)).ravel(), np.repeat(np.sqrt(1 - HUBER / far), k)
    excess = _plain_sums(columns[:, numbers] * root, residual[numbers] * root, plain.basis, k * count)
    return replace(
        plain,
        core=plain.core - excess.core,
        slope=plain.slope - excess.slope,
        square=plain.square - excess.square,
        held=_by_view(0.5 * HUBER * (far - HUBER), count),
    )


def _by_view(numbers: Array, count: Index) -> Array:
    """(V,) sums of so many of the numbers (n,) each."""
    sums, some = np.zeros(len(count)), count > 0
    sums[some] = np.add.reduceat(numbers, (np.cumsum(count) - count)[some])
    return sums


def _sizes(residual: Array) -> Array:
    """(N,) lengths of residuals (N, k)."""
    return np.linalg.norm(residual, axis=1) if residual.shape[1] > 1 else np.abs(residual[:, 0])


def _spread(basis: Array, sway: Array) -> Array:
    """(V, q, q) covariance, in the numbers that measurements depend on, of a displacement with variances (p,)."""
    return np.asarray((basis * sway) @ np.swapaxes(basis, -1, -2))


def _shrink(core: Array, spread: Array) -> Array:
    """``inv(I + core @ spread)`` (V, q, q)."""
    return np.asarray(np.linalg.inv(np.eye(core.shape[-1]) + core @ spread))


def _times(A: Array, x: Array) -> Array:
    """Matrices (V, n, p) times vectors (V, p)."""
    return np.asarray((A @ x[..., None])[..., 0])


def whitening(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """``L`` (V, p, p) with ``L @ A @ L.T`` of information A the identity where it is measured, (V, p)."""
    # Metres and radians do not compare: first to a unit diagonal.
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / size[..., :, None] / size[..., None, :])
    seen = values > _RANK * values[..., -1:]
    root = np.where(seen, values, 1.0) ** -0.5 * seen
    return root[..., :, None] * np.swapaxes(vectors, -1, -2) / size[..., None, :], seen


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
    whiten, seen = whitening(information)
    forced = whiten @ information
    redundancy = seen[..., :, None] * np.eye(seen.shape[-1]) - forced @ spread @ np.swapaxes(forced, -1, -2)
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

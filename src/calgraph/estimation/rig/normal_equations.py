"""From measurements to the normal equations of views: outliers held off, common errors allowed for."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc, gammaln

from calgraph.estimation.rig.observations import LinearizedResiduals
from calgraph.geometry import Array, Index

# Residuals beyond so many standard deviations count less (Huber): Gaussian noise loses 0.3 % of its information.
HUBER_THRESHOLD = 2.5
# Times at most that outliers of a view are judged anew about where it then is.
_MAX_REWEIGHTINGS = 3
# They are not if that is where it was, to such a share of their standard deviations, root mean square.
_REWEIGHTING_TOLERANCE = 1e-2
# Directions of a view with less than this share of its information are not measured by it.
_RANK_TOLERANCE = 1e-10
# Directions of a view that the others check with less than this share of its weight are not checked.
_MIN_REDUNDANCY = 1e-3


@dataclass(frozen=True, eq=False)
class ViewNormalEquations:
    """What V views say, summed over their measurements."""

    JtJ: Array
    """(V, q, q) information on the q numbers that the measurements depend on."""
    Jtr: Array
    """(V, q) gradient by them."""
    local_jacobian: Array
    """(V, q, p): how they move with the pose and the sensor's own unknowns."""
    squared_residuals: Array
    """(V,) weighted sum of squared residuals."""
    robust_cost_offset: Array
    """(V,) what it costs to hold outliers off, in half squares: the robust cost is this and half of ``square``."""
    residual_count: NDArray[np.intp]
    """(V,) how many numbers were measured."""

    @property
    def information(self) -> Array:
        """(V, p, p)."""
        return np.asarray(np.swapaxes(self.local_jacobian, -1, -2) @ self.JtJ @ self.local_jacobian)

    @property
    def gradient(self) -> Array:
        """(V, p)."""
        return np.asarray((np.swapaxes(self.local_jacobian, -1, -2) @ self.Jtr[..., None])[..., 0])

    def within_view_scatter(self) -> tuple[Array, NDArray[np.intp]]:
        """Squared residuals (V,) about each view's own best fit, and how many numbers are left to scatter (V,).

        They tell the noise of single measurements, however wrong sensors and board are placed.
        """
        whiten, seen = whitening(self.JtJ)
        explained = np.sum(_matvec(whiten, self.Jtr) ** 2, axis=-1)
        return self.squared_residuals - explained, self.residual_count - np.sum(seen, axis=-1)

    def fit(self) -> Array:
        """(V, q) by how much the numbers that measurements depend on are to change to fit each view best."""
        whiten, _ = whitening(self.JtJ)
        return -_matvec(np.swapaxes(whiten, -1, -2), _matvec(whiten, self.Jtr))

    def select(self, keep: NDArray[np.bool_] | Index) -> "ViewNormalEquations":
        """Those of some of the views: a mask (V,), or their numbers, which may repeat."""
        return ViewNormalEquations(
            self.JtJ[keep],
            self.Jtr[keep],
            self.local_jacobian[keep],
            self.squared_residuals[keep],
            self.robust_cost_offset[keep],
            self.residual_count[keep],
        )

    def squared_change(self, change: Array) -> Array:
        """(V,) by how much residuals change, squared and summed, as the numbers do that they depend on (V, q)."""
        return np.asarray(np.einsum("vi,vij,vj->v", change, self.JtJ, change))

    def extrapolate(self, change: Array, basis: Array) -> "ViewNormalEquations":
        """The sums after the numbers that measurements depend on have changed by (V, q), to first order in these.

        Measurements keep the weights that they have; ``basis`` is the new one.
        """
        slope = self.Jtr + _matvec(self.JtJ, change)
        square = self.squared_residuals + np.sum(change * (self.Jtr + slope), axis=-1)
        return replace(self, Jtr=slope, squared_residuals=square, local_jacobian=basis)

    def marginalize_bias(self, sway: Array) -> tuple[Array, Array, Array]:
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
            return self.JtJ, self.Jtr, self.robust_cost_offset + 0.5 * self.squared_residuals
        spread = _bias_covariance(self.local_jacobian, sway)
        shrink = _bias_shrinkage(self.JtJ, spread)
        A, slope = shrink @ self.JtJ, _matvec(shrink, self.Jtr)
        explained = np.sum(_matvec(spread, slope) * self.Jtr, axis=-1)
        return (
            (A + np.swapaxes(A, -1, -2)) / 2,
            slope,
            self.robust_cost_offset + 0.5 * (self.squared_residuals - explained),
        )

    def estimate_bias(self, spread: Array) -> Array:
        """(V, q) the likeliest displacement, if it has the covariance ``spread`` (V, q, q)."""
        return -_matvec(spread @ _bias_shrinkage(self.JtJ, spread), self.Jtr)


def accumulate(
    rows: LinearizedResiduals,
    start: Index,
    fitted: Callable[[ViewNormalEquations], Array] = ViewNormalEquations.fit,
) -> ViewNormalEquations:
    """Sums rows over views, which start at ``start`` (V,).

    Which measurements are outliers is judged where each view itself would have its board: where it is displaced as
    a whole, all of its measurements are off, and none of them is wrong.

    Args:
        rows: of N measurements.
        start: (V,).
        fitted: (V, q) from sums, where the views are to be judged.
    """
    columns, residual = _jacobian_columns(rows), rows.residual.ravel()
    count = np.diff(start, append=len(rows.residual)) * rows.residual.shape[1]
    plain = sums = _accumulate_unweighted(columns, residual, rows.local_jacobian, count)
    shift = fitted(sums)
    for _ in range(_MAX_REWEIGHTINGS):
        off = residual + np.einsum("in,in->n", columns, np.repeat(shift.T, count, axis=1))
        size = _residual_norms(off.reshape(rows.residual.shape))
        if not np.any(size > HUBER_THRESHOLD):
            return plain
        sums = _downweight_outliers(plain, columns, residual, start, size)
        before, shift = shift, fitted(sums)
        if np.all(plain.squared_change(shift - before) <= _REWEIGHTING_TOLERANCE**2 * count):
            break
    return sums


def accumulate_biased(rows: LinearizedResiduals, start: Index, sway: Array) -> ViewNormalEquations:
    """Sums rows over views, which start at ``start`` (V,): outliers are judged where each view likeliest sways."""
    spread = _bias_covariance(rows.local_jacobian, sway)
    return accumulate(rows, start, lambda sums: sums.estimate_bias(spread))


def _jacobian_columns(rows: LinearizedResiduals) -> Array:
    """(q, N·k) derivatives of all residuals, one number after the other in memory."""
    return np.ascontiguousarray(rows.jacobian.reshape(-1, rows.jacobian.shape[-1]).T)


def _accumulate_unweighted(columns: Array, residual: Array, basis: Array, count: Index) -> ViewNormalEquations:
    """Sums of derivatives (q, n) and residuals (n,), so many of each view, all of which count in full."""
    q = len(columns)
    core, slope = np.empty((len(count), q, q)), np.empty((len(count), q))
    for i in range(q):
        for j in range(i, q):
            core[:, i, j] = core[:, j, i] = _sum_by_view(columns[i] * columns[j], count)
        slope[:, i] = _sum_by_view(columns[i] * residual, count)
    return ViewNormalEquations(core, slope, basis, _sum_by_view(residual**2, count), np.zeros(len(count)), count)


def _downweight_outliers(
    plain: ViewNormalEquations, columns: Array, residual: Array, start: Index, size: Array
) -> ViewNormalEquations:
    """The sums with outliers weighed by ``HUBER / size`` instead of in full.

    Args:
        plain: in which all count in full.
        columns: (q, N·k) derivatives.
        residual: (N·k,).
        start: (V,) where views begin.
        size: (N,) how far off measurements are where they are judged.
    """
    outlying = np.flatnonzero(size > HUBER_THRESHOLD)
    far, k = size[outlying], len(residual) // max(len(size), 1)
    count = np.bincount(np.searchsorted(start, outlying, side="right") - 1, minlength=len(start))
    numbers, root = (
        (k * outlying[:, None] + np.arange(k)).ravel(),
        np.repeat(np.sqrt(1 - HUBER_THRESHOLD / far), k),
    )
    excess = _accumulate_unweighted(
        columns[:, numbers] * root, residual[numbers] * root, plain.local_jacobian, k * count
    )
    return replace(
        plain,
        JtJ=plain.JtJ - excess.JtJ,
        Jtr=plain.Jtr - excess.Jtr,
        squared_residuals=plain.squared_residuals - excess.squared_residuals,
        robust_cost_offset=_sum_by_view(0.5 * HUBER_THRESHOLD * (far - HUBER_THRESHOLD), count),
    )


def _sum_by_view(numbers: Array, count: Index) -> Array:
    """(V,) sums of so many of the numbers (n,) each."""
    sums, some = np.zeros(len(count)), count > 0
    sums[some] = np.add.reduceat(numbers, (np.cumsum(count) - count)[some])
    return sums


def _residual_norms(residual: Array) -> Array:
    """(N,) lengths of residuals (N, k)."""
    return np.linalg.norm(residual, axis=1) if residual.shape[1] > 1 else np.abs(residual[:, 0])


def _bias_covariance(basis: Array, sway: Array) -> Array:
    """(V, q, q) covariance, in the numbers that measurements depend on, of a displacement with variances (p,)."""
    return np.asarray((basis * sway) @ np.swapaxes(basis, -1, -2))


def _bias_shrinkage(core: Array, spread: Array) -> Array:
    """``inv(I + core @ spread)`` (V, q, q)."""
    return np.asarray(np.linalg.inv(np.eye(core.shape[-1]) + core @ spread))


def _matvec(A: Array, x: Array) -> Array:
    """Matrices (V, n, p) times vectors (V, p)."""
    return np.asarray((A @ x[..., None])[..., 0])


def whitening(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """``L`` (V, p, p) with ``L @ A @ L.T`` of information A the identity where it is measured, (V, p)."""
    # Metres and radians do not compare: first to a unit diagonal.
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / size[..., :, None] / size[..., None, :])
    seen = values > _RANK_TOLERANCE * values[..., -1:]
    root = np.where(seen, values, 1.0) ** -0.5 * seen
    return root[..., :, None] * np.swapaxes(vectors, -1, -2) / size[..., None, :], seen


def consistency_statistic(information: Array, spread: Array, gradient: Array) -> tuple[Array, NDArray[np.intp]]:
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
    checked = free > _MIN_REDUNDANCY
    along = (np.swapaxes(axes, -1, -2) @ whiten @ gradient[..., None])[..., 0]
    squared = np.sum(checked * along**2 / np.where(checked, free, 1.0), axis=-1)
    return squared, np.asarray(checked.sum(axis=-1), dtype=np.intp)


def huber_variance_factor(dimension: int) -> float:
    """Mean of ``weight * |r|²`` over its degrees of freedom, for Gaussian residuals ``r`` of so many numbers."""
    d, h = dimension, HUBER_THRESHOLD
    inside = d * chdtr(d + 2, h**2)
    outside = h * np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2)) * chdtrc(d + 1, h**2)
    return float((inside + outside) / d)

"""From whitened residuals to the normal equations of views, with robust weights and a marginalised view bias."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc, gammaln

from calgraph.estimation.marginalization import compute_bias_covariance, marginalize_bias
from calgraph.estimation.rig.observations import LinearizedResiduals
from calgraph.geometry import Array, Index, se_n

# Limit on the robust weights' iterations, which hardly ever binds.
_MAX_REWEIGHTINGS = 3
# They stop where a view's fit moves by less than this share of its standard deviations, root mean square.
_REWEIGHTING_TOLERANCE = 1e-2
# Directions with less than this share of a view's largest information count as not measured by it: a numerical
# rank.
_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class ViewNormalEquations:
    """The normal equations of V views, each summed over its measurements."""

    JtJ: Array
    """(V, q, q) information on the local parameters of each view."""
    Jtr: Array
    """(V, q) gradient by these."""
    local_jacobian: Array
    """(V, q, p) derivatives of the local parameters by the board's pose and the sensor's extra parameters."""
    squared_residuals: Array
    """(V,) weighted sum of squared residuals."""
    robust_cost_offset: Array
    """(V,) robust cost beyond half of ``squared_residuals``, which down-weighted outliers contribute."""
    residual_count: NDArray[np.intp]
    """(V,) number of residuals."""

    @property
    def information(self) -> Array:
        """(V, p, p)."""
        return np.asarray(se_n.transpose(self.local_jacobian) @ self.JtJ @ self.local_jacobian)

    @property
    def gradient(self) -> Array:
        """(V, p)."""
        return np.asarray((se_n.transpose(self.local_jacobian) @ self.Jtr[..., None])[..., 0])

    def within_view_scatter(self) -> tuple[Array, NDArray[np.intp]]:
        """Squared residuals (V,) about the best fit of each view alone, and their degrees of freedom (V,).

        They measure the noise of single measurements, independent of errors of the poses.
        """
        whiten, measured = whitening(self.JtJ)
        explained = np.sum(_matvec(whiten, self.Jtr) ** 2, axis=-1)
        return self.squared_residuals - explained, self.residual_count - np.sum(measured, axis=-1)

    def fit(self) -> Array:
        """(V, q) change of the local parameters to the best fit of each view alone."""
        whiten, _ = whitening(self.JtJ)
        return -_matvec(se_n.transpose(whiten), _matvec(whiten, self.Jtr))

    def select(self, keep: NDArray[np.bool_] | Index) -> "ViewNormalEquations":
        """Those of some of the views: a mask (V,), or indices, which may repeat."""
        return ViewNormalEquations(
            self.JtJ[keep],
            self.Jtr[keep],
            self.local_jacobian[keep],
            self.squared_residuals[keep],
            self.robust_cost_offset[keep],
            self.residual_count[keep],
        )

    def squared_change(self, change: Array) -> Array:
        """(V,) sum of squared changes of the residuals for changes (V, q) of the local parameters."""
        return np.asarray(np.einsum("vi,vij,vj->v", change, self.JtJ, change))

    def extrapolate(self, change: Array, local_jacobian: Array) -> "ViewNormalEquations":
        """The equations after a change (V, q) of the local parameters, to first order of the residuals in it.

        Robust weights are kept; ``local_jacobian`` is that at the new poses.
        """
        Jtr = self.Jtr + _matvec(self.JtJ, change)
        squared_residuals = self.squared_residuals + np.sum(change * (self.Jtr + Jtr), axis=-1)
        return replace(self, Jtr=Jtr, squared_residuals=squared_residuals, local_jacobian=local_jacobian)

    def marginalize_bias(self, variance: Array) -> tuple[Array, Array, Array]:
        """Information, gradients and costs with a bias of each view marginalised.

        A bent board, a range error on one material, a late stamp: the errors of one view's measurements are
        correlated, and do not average out. The bias is modelled as a displacement of the board before the sensor
        with covariance Q; information A becomes ``(A⁻¹ + Q)⁻¹``.

        Args:
            variance: (p,) diagonal of Q along the sensor's axes; 0 for the sensor's extra parameters.

        Returns:
            (V, q, q), (V, q) and (V,).
        """
        cost = self.robust_cost_offset + 0.5 * self.squared_residuals
        if not np.any(variance):
            return self.JtJ, self.Jtr, cost
        return marginalize_bias(self.JtJ, self.Jtr, cost, _bias_prior(self.local_jacobian, variance))

    def estimate_bias(self, prior: Array) -> Array:
        """(V, q) most likely bias, for its prior covariance (V, q, q)."""
        return -_matvec(compute_bias_covariance(self.JtJ, prior), self.Jtr)


def accumulate(
    residuals: LinearizedResiduals,
    start: Index,
    huber_threshold: float,
    fit: Callable[[ViewNormalEquations], Array] = ViewNormalEquations.fit,
) -> ViewNormalEquations:
    """Sums residuals into the normal equations of views.

    Robust weights are computed at the best fit of each view: a bias moves all residuals of a view, and must not
    turn them into outliers.

    Args:
        residuals: of N measurements.
        start: (V,) the first measurement of each view.
        huber_threshold: norm of a whitened residual beyond which it is down-weighted.
        fit: from the equations to the change (V, q) of local parameters at which weights are computed.
    """
    columns, residual = _jacobian_columns(residuals), residuals.residual.ravel()
    count = np.diff(start, append=len(residuals.residual)) * residuals.residual.shape[1]
    unweighted = equations = _accumulate_unweighted(columns, residual, residuals.local_jacobian, count)
    shift = fit(equations)
    for _ in range(_MAX_REWEIGHTINGS):
        about_fit = residual + np.einsum("in,in->n", columns, np.repeat(shift.T, count, axis=1))
        norm = _residual_norms(about_fit.reshape(residuals.residual.shape))
        if not np.any(norm > huber_threshold):
            return unweighted
        equations = _downweight_outliers(unweighted, columns, residual, start, norm, huber_threshold)
        before, shift = shift, fit(equations)
        if np.all(unweighted.squared_change(shift - before) <= _REWEIGHTING_TOLERANCE**2 * count):
            break
    return equations


def accumulate_biased(
    residuals: LinearizedResiduals, start: Index, variance: Array, huber_threshold: float
) -> ViewNormalEquations:
    """As :func:`accumulate`, with robust weights at the most likely bias for its ``variance`` (p,)."""
    prior = _bias_prior(residuals.local_jacobian, variance)
    return accumulate(residuals, start, huber_threshold, lambda equations: equations.estimate_bias(prior))


def _jacobian_columns(residuals: LinearizedResiduals) -> Array:
    """(q, N·k) derivatives, one column of the Jacobian after the other in memory."""
    return np.ascontiguousarray(residuals.jacobian.reshape(-1, residuals.jacobian.shape[-1]).T)


def _accumulate_unweighted(
    columns: Array, residual: Array, local_jacobian: Array, count: Index
) -> ViewNormalEquations:
    """Normal equations with unit weights of derivatives (q, n) and residuals (n,), ``count`` (V,) of each view."""
    q = len(columns)
    JtJ, Jtr = np.empty((len(count), q, q)), np.empty((len(count), q))
    for i in range(q):
        for j in range(i, q):
            JtJ[:, i, j] = JtJ[:, j, i] = _sum_by_view(columns[i] * columns[j], count)
        Jtr[:, i] = _sum_by_view(columns[i] * residual, count)
    return ViewNormalEquations(
        JtJ, Jtr, local_jacobian, _sum_by_view(residual**2, count), np.zeros(len(count)), count
    )


def _downweight_outliers(
    unweighted: ViewNormalEquations,
    columns: Array,
    residual: Array,
    start: Index,
    norm: Array,
    huber_threshold: float,
) -> ViewNormalEquations:
    """The normal equations with outliers weighted by ``huber_threshold / norm``.

    Args:
        unweighted: with unit weights.
        columns: (q, N·k) derivatives.
        residual: (N·k,).
        start: (V,) the first measurement of each view.
        norm: (N,) of the residuals that decide the weights.
        huber_threshold: of the norm.
    """
    outlier = np.flatnonzero(norm > huber_threshold)
    far, k = norm[outlier], len(residual) // max(len(norm), 1)
    count = np.bincount(np.searchsorted(start, outlier, side="right") - 1, minlength=len(start))
    index = (k * outlier[:, None] + np.arange(k)).ravel()
    root = np.repeat(np.sqrt(1 - huber_threshold / far), k)
    excess = _accumulate_unweighted(
        columns[:, index] * root, residual[index] * root, unweighted.local_jacobian, k * count
    )
    return replace(
        unweighted,
        JtJ=unweighted.JtJ - excess.JtJ,
        Jtr=unweighted.Jtr - excess.Jtr,
        squared_residuals=unweighted.squared_residuals - excess.squared_residuals,
        robust_cost_offset=_sum_by_view(0.5 * huber_threshold * (far - huber_threshold), count),
    )


def _sum_by_view(values: Array, count: Index) -> Array:
    """(V,) sums of values (n,), ``count`` (V,) of each view."""
    sums, some = np.zeros(len(count)), count > 0
    sums[some] = np.add.reduceat(values, (np.cumsum(count) - count)[some])
    return sums


def _residual_norms(residual: Array) -> Array:
    """(N,) norms of residuals (N, k)."""
    return np.linalg.norm(residual, axis=1) if residual.shape[1] > 1 else np.abs(residual[:, 0])


def _bias_prior(local_jacobian: Array, variance: Array) -> Array:
    """(V, q, q) covariance of the local parameters for a displacement of the board with variances (p,)."""
    return np.asarray((local_jacobian * variance) @ se_n.transpose(local_jacobian))


def _matvec(A: Array, x: Array) -> Array:
    """Matrices (V, n, p) times vectors (V, p)."""
    return np.asarray((A @ x[..., None])[..., 0])


def whitening(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """``L`` (V, p, p) with ``L @ A @ L.T`` of information A the identity where it is measured, (V, p)."""
    # Metres and radians do not compare: scale to a unit diagonal first.
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / size[..., :, None] / size[..., None, :])
    measured = values > _RANK_TOLERANCE * values[..., -1:]
    root = np.where(measured, values, 1.0) ** -0.5 * measured
    return root[..., :, None] * se_n.transpose(vectors) / size[..., None, :], measured


def consistency_statistic(
    information: Array, covariance: Array, gradient: Array, min_redundancy: float
) -> tuple[Array, NDArray[np.intp]]:
    """Test statistic of each view against the solution that it is part of.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968.

    Args:
        information: (V, p, p) A of each view.
        covariance: (V, p, p) P of the solution in the view's parameters, the view's contribution included.
        gradient: (V, p) of each view at the solution; its covariance is A - A P A.
        min_redundancy: least redundancy number of a direction, its share of A that the other views determine.

    Returns:
        Squared Mahalanobis distances (V,) of the gradients from zero, and their degrees of freedom (V,), without
        directions of smaller redundancy.
    """
    whiten, measured = whitening(information)
    forced = whiten @ information
    redundancy = measured[..., :, None] * np.eye(measured.shape[-1]) - forced @ covariance @ se_n.transpose(forced)
    values, axes = np.linalg.eigh((redundancy + se_n.transpose(redundancy)) / 2)
    checked = values > min_redundancy
    along = (se_n.transpose(axes) @ whiten @ gradient[..., None])[..., 0]
    squared = np.sum(checked * along**2 / np.where(checked, values, 1.0), axis=-1)
    return squared, np.asarray(checked.sum(axis=-1), dtype=np.intp)


def huber_variance_factor(dimension: int, huber_threshold: float) -> float:
    """Mean of ``weight * |r|²`` over its degrees of freedom, for Gaussian residuals r of this dimension."""
    d, h = dimension, huber_threshold
    inside = d * chdtr(d + 2, h**2)
    outside = h * np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2)) * chdtrc(d + 1, h**2)
    return float((inside + outside) / d)

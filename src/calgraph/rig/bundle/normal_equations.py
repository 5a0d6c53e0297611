"""From whitened residuals to the normal equations of views, with robust weights and a marginalised view bias."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtrc, gammaln

from calgraph.geometry import Array, Index, matvec, se_n
from calgraph.rig.bundle.observations import LinearizedResiduals, view_indices
from calgraph.solver.marginalization import compute_bias_covariance, marginalize_bias

# Limit on the robust weights' iterations, which hardly ever binds.
_MAX_REWEIGHTINGS = 3
# They stop where a view's fit moves by less than this share of its standard deviations, root mean square.
_REWEIGHTING_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class BiasVariances:
    """Variances of the bias of each of V views, or of all of them."""

    pose: Array
    """(V, 6) or (6,) of the board's displacement, m², and rotation, rad², along the sensor's axes."""
    ring: Array
    """(V,) or () of the ranges of a ring, m²."""
    stamp: Array
    """(V,) or () of the stamp, s²: it displaces a moving board along its velocity."""


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
    pose_count: int
    """Number of local parameters of the pose, the first ones."""
    ring_count: int = 0
    """Number R of the last local parameters that are biased from view to view, each of different measurements."""
    velocity: Array | None = None
    """(V, 6) as of :class:`LinearizedResiduals`."""

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
        whiten, measured = self.whiten_views()
        explained = np.sum(matvec(whiten, self.Jtr) ** 2, axis=-1)
        return self.squared_residuals - explained, self.residual_count - np.sum(measured, axis=-1)

    def fit(self) -> Array:
        """(V, q) change of pose and rings to the best fit of each view alone; other parameters do not change."""
        whiten, _ = self.whiten_views()
        return -matvec(se_n.transpose(whiten), matvec(whiten, self.Jtr))

    def whiten_views(self) -> tuple[Array, NDArray[np.bool_]]:
        """``L`` (V, n, q) with ``L @ JtJ @ L.T`` the identity where it is measured, (V, n): of the pose and rings.

        Each ring's bias depends on its measurements only, so that rings are eliminated one by one.
        """
        p, (views, q) = self.pose_count, self.Jtr.shape
        rings = np.arange(q - self.ring_count, q)
        of_rings = self.JtJ[:, rings, rings]
        some = of_rings > 0
        inverse = np.where(some, 1 / np.where(some, of_rings, 1.0), 0.0)
        coupling = self.JtJ[:, :p, rings] * inverse[:, None]
        of_pose = self.JtJ[:, :p, :p] - coupling @ self.JtJ[:, rings, :p]
        whiten, measured = whitening(of_pose, np.diagonal(self.JtJ, axis1=-2, axis2=-1)[:, :p])
        L = np.zeros((views, p + self.ring_count, q))
        L[:, :p, :p], L[:, :p, rings] = whiten, -whiten @ coupling
        L[:, p + np.arange(self.ring_count), rings] = np.sqrt(inverse)
        return L, np.concatenate([measured, some], axis=1)

    def select(self, keep: NDArray[np.bool_] | Index) -> "ViewNormalEquations":
        """Those of some of the views: a mask (V,), or indices, which may repeat."""
        of_views = (
            "JtJ", "Jtr", "local_jacobian", "squared_residuals", "robust_cost_offset", "residual_count", "velocity"
        )  # fmt: skip
        known = {name: values for name in of_views if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[keep] for name, values in known.items()})

    def squared_change(self, change: Array) -> Array:
        """(V,) sum of squared changes of the residuals for changes (V, q) of the local parameters."""
        return np.asarray(np.sum(change * matvec(self.JtJ, change), axis=-1))

    def extrapolate(self, change: Array, local_jacobian: Array) -> "ViewNormalEquations":
        """The equations after a change (V, q) of the local parameters, to first order of the residuals in it.

        Robust weights are kept; ``local_jacobian`` is that at the new poses.
        """
        Jtr = self.Jtr + matvec(self.JtJ, change)
        squared_residuals = self.squared_residuals + np.sum(change * (self.Jtr + Jtr), axis=-1)
        return replace(self, Jtr=Jtr, squared_residuals=squared_residuals, local_jacobian=local_jacobian)

    def marginalize_bias(self, variances: BiasVariances) -> tuple[Array, Array, Array]:
        """Information, gradients and costs with a bias of each view marginalised.

        A bent board, a range error on one material, a late stamp: the errors of one view's measurements are
        correlated, and do not average out. The bias is modelled as a displacement of the board before the sensor,
        and of each ring's ranges, with covariance Q; information A becomes ``(A⁻¹ + Q)⁻¹``.

        Returns:
            (V, q, q), (V, q) and (V,).
        """
        cost = self.robust_cost_offset + 0.5 * self.squared_residuals
        if not any(map(np.any, (variances.pose, variances.ring, variances.stamp))):
            return self.JtJ, self.Jtr, cost
        A, b = self.JtJ, self.Jtr
        if np.any(variances.ring):
            to_rings, P, shift = self._ring_biases(variances.ring)
            n = A.shape[-1] - self.ring_count
            # Rings are coupled to the other parameters, but not to each other.
            left = 1 - P * self.JtJ[:, np.arange(n, A.shape[-1]), np.arange(n, A.shape[-1])]
            coupling, A = to_rings[:, :n], A.copy()
            A[:, :n, :n] -= (coupling * P[:, None]) @ se_n.transpose(coupling)
            A[:, :n, n:] = coupling * left[:, None]
            A[:, n:] *= left[..., None]
            b = b - matvec(to_rings, shift)
            cost = cost - 0.5 * np.sum(self._of_rings(self.Jtr) * shift, axis=-1)
        return marginalize_bias(A, b, cost, self._pose_bias_prior(variances))

    def estimate_bias(self, variances: BiasVariances) -> Array:
        """(V, q) most likely bias."""
        p, shift = self.pose_count, np.zeros_like(self.Jtr)
        A, b = self.JtJ[:, :p, :p], self.Jtr[:, :p]
        has_rings = np.any(variances.ring)
        if has_rings:
            to_rings, P, of_rings = self._ring_biases(variances.ring)
            A = A - (to_rings[:, :p] * P[:, None]) @ se_n.transpose(to_rings[:, :p])
            b = b - matvec(to_rings[:, :p], of_rings)
        shift[:, :p] = -matvec(compute_bias_covariance(A, self._pose_bias_prior(variances)), b)
        if has_rings:
            of_rings = of_rings + P * matvec(se_n.transpose(to_rings[:, :p]), shift[:, :p])
            shift[:, shift.shape[1] - self.ring_count :] = -of_rings
        return shift

    def multiply_bias_covariance(self, variances: BiasVariances, values: Array) -> Array:
        """``Q @ values`` (V, q, m) with the covariance Q of the biases of each view's local parameters."""
        p, rings = self.pose_count, slice(values.shape[1] - self.ring_count, None)
        product = np.zeros_like(values)
        product[:, :p] = self._pose_bias_prior(variances) @ values[:, :p]
        product[:, rings] = variances.ring[..., None, None] * values[:, rings]
        return product

    def _ring_biases(self, variance: Array) -> tuple[Array, Array, Array]:
        """Information (V, q, R) between parameters and rings, and variances and sizes (V, R) of rings' biases.

        The other biases are zero; those of rings are then independent of each other.
        """
        rings = np.arange(self.JtJ.shape[-1] - self.ring_count, self.JtJ.shape[-1])
        P = variance[..., None] / (1 + variance[..., None] * self.JtJ[:, rings, rings])
        return self.JtJ[:, :, rings], P, P * self._of_rings(self.Jtr)

    def _of_rings(self, values: Array) -> Array:
        """(V, R) of (V, q)."""
        return values[:, values.shape[1] - self.ring_count :]

    def _pose_bias_prior(self, variances: BiasVariances) -> Array:
        """(V, p, p) covariance of the displacement of the local parameters of the pose."""
        J = self.local_jacobian[:, : self.pose_count, :6]
        Q = (J * variances.pose[..., None, :]) @ se_n.transpose(J)
        if self.velocity is not None and np.any(variances.stamp):
            moved = J @ self.velocity[..., None]
            Q = Q + variances.stamp[..., None, None] * moved @ se_n.transpose(moved)
        return np.asarray(Q)


@dataclass(frozen=True, eq=False)
class _Groups:
    """Consecutive residuals of one view or, where there are rings, of one ring in one view."""

    count: Index
    """(M,) number of residuals of each."""
    view: Index
    """(M,)."""
    ring: Index | None
    """(M,)."""
    views: int
    """Number V of views."""

    def sum_by_view(self, sums: Array) -> Array:
        """(V, ...) sums of the groups' (M, ...)."""
        if self.ring is None:
            return sums
        total = np.zeros((self.views, *sums.shape[1:]))
        np.add.at(total, self.view, sums)
        return total

    def subset(self, index: Index) -> "_Groups":
        """The groups of some residuals, by their ascending indices."""
        ends = np.cumsum(self.count)
        return replace(self, count=np.bincount(np.searchsorted(ends, index, side="right"), minlength=len(ends)))


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
    # One column of the Jacobian (q - R, N·k) after the other in memory.
    columns = np.ascontiguousarray(residuals.jacobian.reshape(-1, residuals.jacobian.shape[-1]).T)
    residual = residuals.residual.ravel()
    groups = _group_residuals(residuals, start)
    unweighted = equations = _accumulate_unweighted(columns, residual, residuals, groups)
    shift = fit(equations)
    for _ in range(_MAX_REWEIGHTINGS):
        by_group = shift[groups.view, : len(columns)]
        if groups.ring is not None:
            by_group[:, residuals.ring_column] += shift[groups.view, len(columns) + groups.ring]
        about_fit = residual + np.einsum("in,in->n", columns, np.repeat(by_group.T, groups.count, axis=1))
        about_fit = about_fit.reshape(residuals.residual.shape)
        norm = np.linalg.norm(about_fit, axis=1) if about_fit.shape[1] > 1 else np.abs(about_fit[:, 0])
        if not np.any(norm > huber_threshold):
            return unweighted
        equations = _downweight_outliers(unweighted, columns, residuals, groups, norm, huber_threshold)
        before, shift = shift, fit(equations)
        moved = unweighted.squared_change(shift - before)
        if np.all(moved <= _REWEIGHTING_TOLERANCE**2 * unweighted.residual_count):
            break
    return equations


def _group_residuals(residuals: LinearizedResiduals, start: Index) -> _Groups:
    """The groups of residuals of views that begin at ``start`` (V,)."""
    N, k = residuals.residual.shape
    if residuals.ring is None:
        count = np.diff(start, append=N) * k
        return _Groups(count, np.arange(len(start)), None, len(start))
    view = view_indices(start, N)
    first = np.flatnonzero(np.diff(view * (residuals.ring.max(initial=0) + 1) + residuals.ring, prepend=-1))
    return _Groups(np.diff(first, append=N) * k, view[first], residuals.ring[first], len(start))


# Products of two columns in a group, of all pairs of columns together, from which the matrices of groups are
# multiplied one by one, which takes 4 µs each: of fewer, as of rings, sums of columns over all groups are faster.
_MANY_PRODUCTS = 2000


def _accumulate_unweighted(
    columns: Array, residual: Array, residuals: LinearizedResiduals, groups: _Groups
) -> ViewNormalEquations:
    """Normal equations with unit weights of derivatives (q - R, n) and residuals (n,) in groups."""
    q, views = len(columns), groups.views
    R = residuals.local_jacobian.shape[1] - q
    augmented = np.concatenate([columns, residual[None]])
    products, squares = np.empty((len(groups.count), q + 1, q + 1)), np.empty_like(augmented)
    begin, some = np.cumsum(groups.count) - groups.count, groups.count > 0
    one_by_one = (q + 1) ** 2 * len(residual) > _MANY_PRODUCTS * len(begin)
    if one_by_one:
        for group, (first, count) in enumerate(zip(begin, groups.count, strict=True)):
            of_group = augmented[:, first : first + count]
            products[group] = of_group @ of_group.T
    for i in range(0 if one_by_one else q + 1):
        of_column = np.multiply(augmented[i:], augmented[i], out=squares[i:])
        products[:, i, i:] = products[:, i:, i] = _sum_groups(of_column, begin, some).T
    of_views = groups.sum_by_view(products)
    JtJ, Jtr = np.zeros((views, q + R, q + R)), np.zeros((views, q + R))
    JtJ[:, :q, :q], Jtr[:, :q] = of_views[:, :q, :q], of_views[:, :q, q]
    if groups.ring is not None:
        c, (view, ring) = residuals.ring_column, (groups.view, q + groups.ring)
        JtJ[view, :q, ring] = JtJ[view, ring, :q] = products[:, c, :q]
        JtJ[view, ring, ring], Jtr[view, ring] = products[:, c, c], products[:, c, q]
    return ViewNormalEquations(
        JtJ,
        Jtr,
        residuals.local_jacobian,
        of_views[:, q, q],
        np.zeros(views),
        groups.sum_by_view(groups.count.astype(np.float64)).astype(np.intp),
        residuals.pose_count,
        residuals.ring_count,
        residuals.velocity,
    )


def _downweight_outliers(
    unweighted: ViewNormalEquations,
    columns: Array,
    residuals: LinearizedResiduals,
    groups: _Groups,
    norm: Array,
    huber_threshold: float,
) -> ViewNormalEquations:
    """The normal equations with outliers weighted by ``huber_threshold / norm``.

    Args:
        unweighted: with unit weights.
        columns: (q - R, N·k) derivatives.
        residuals: of N measurements.
        groups: of their N·k values.
        norm: (N,) of the residuals that decide the weights.
        huber_threshold: of the norm.
    """
    outlier, residual = np.flatnonzero(norm > huber_threshold), residuals.residual.ravel()
    far, k = norm[outlier], residuals.residual.shape[1]
    index = (k * outlier[:, None] + np.arange(k)).ravel()
    root = np.repeat(np.sqrt(1 - huber_threshold / far), k)
    subset = groups.subset(index)
    excess = _accumulate_unweighted(columns[:, index] * root, residual[index] * root, residuals, subset)
    offsets = np.repeat(0.5 * huber_threshold * (far - huber_threshold) / k, k)
    return replace(
        unweighted,
        JtJ=unweighted.JtJ - excess.JtJ,
        Jtr=unweighted.Jtr - excess.Jtr,
        squared_residuals=unweighted.squared_residuals - excess.squared_residuals,
        robust_cost_offset=groups.sum_by_view(
            _sum_groups(offsets, np.cumsum(subset.count) - subset.count, subset.count > 0)
        ),
    )


def _sum_groups(values: Array, begin: Index, some: NDArray[np.bool_]) -> Array:
    """(..., M) sums of values (..., n) in groups that ``begin`` (M,) there, if they have ``some`` (M,)."""
    if some.all():
        return np.asarray(np.add.reduceat(values, begin, axis=-1))
    sums = np.zeros((*values.shape[:-1], len(begin)))
    if some.any():
        sums[..., some] = np.add.reduceat(values, begin[some], axis=-1)
    return sums


def huber_variance_factor(dimension: int, huber_threshold: float) -> float:
    """Mean of ``weight * |r|²`` over its degrees of freedom, for Gaussian residuals r of this dimension."""
    d, h = dimension, huber_threshold
    inside = d * chdtr(d + 2, h**2)
    outside = h * np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2)) * chdtrc(d + 1, h**2)
    return float((inside + outside) / d)


# Directions with less than this share of a view's largest information count as not measured by it: a numerical
# rank.
_RANK_TOLERANCE = 1e-10


def whitening(information: Array, scale: Array | None = None) -> tuple[Array, NDArray[np.bool_]]:
    """``L`` (V, p, p) with ``L @ A @ L.T`` of information A the identity where it is measured, (V, p).

    Args:
        information: (V, p, p) A.
        scale: (V, p) diagonal relative to which a direction counts as measured; that of A if left out.
    """
    # Metres and radians do not compare: scale to a unit diagonal first.
    diagonal = np.diagonal(information, axis1=-2, axis2=-1) if scale is None else scale
    size = np.sqrt(np.maximum(diagonal, 0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / size[..., :, None] / size[..., None, :])
    measured = values > _RANK_TOLERANCE * np.maximum(values[..., -1:], 0 if scale is None else 1)
    root = np.where(measured, values, 1.0) ** -0.5 * measured
    return root[..., :, None] * se_n.transpose(vectors) / size[..., None, :], measured


def consistency_statistic(
    information: Array, reduction: Array, gradient: Array, min_redundancy: float, *, predicted: bool = False
) -> tuple[Array, NDArray[np.intp]]:
    """Test statistic of each view against the solution that it is part of, or that predicts it.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968.

    Args:
        information: (V, p, p) A of each view.
        reduction: (V, p, p) A P A, with the covariance P of the solution in the view's parameters.
        gradient: (V, p) of each view at the solution; its covariance is A - A P A, or A + A P A if predicted.
        min_redundancy: least redundancy number of a direction, its share of A that the other views determine.
        predicted: whether the solution is without the views' contributions.

    Returns:
        Squared Mahalanobis distances (V,) of the gradients from zero, and their degrees of freedom (V,), without
        directions of smaller redundancy.
    """
    whiten, measured = whitening(information)
    by_solution = whiten @ reduction @ se_n.transpose(whiten)
    redundancy = measured[..., :, None] * np.eye(measured.shape[-1]) + (by_solution if predicted else -by_solution)
    values, axes = np.linalg.eigh((redundancy + se_n.transpose(redundancy)) / 2)
    checked = values > min_redundancy
    along = (se_n.transpose(axes) @ whiten @ gradient[..., None])[..., 0]
    squared = np.sum(checked * along**2 / np.where(checked, values, 1.0), axis=-1)
    return squared, np.asarray(checked.sum(axis=-1), dtype=np.intp)

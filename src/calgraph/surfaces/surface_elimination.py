"""Elimination of surfaces: normal equations of sensors, and of their trajectory, from points.

Points of one sensor on one surface within a second are a view. Each view has a bias, each surface a flat patch
with a relief; both are linear in the residuals and are eliminated in closed form, view biases first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from calgraph.geometry import STDDEV_PER_MAD, Array, Index, se_n
from calgraph.surfaces.surface_points import SurfacePoints


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Standard deviations of residuals."""

    white: Array
    """(S,) of each point of a sensor along the normal, m."""
    view: Array
    """(2,) of the offset of a patch as one sensor measures it within a view, and of its slopes at one standard
    deviation of the points from the middle, m."""

    @classmethod
    def at_start(cls, sensors: int) -> "NoiseModel":
        """Before any residuals."""
        return cls(np.full(sensors, _START_WHITE), np.full(2, _START_VIEW))

    def estimated_again(self, equations: Sequence["SurfaceEquations"]) -> "NoiseModel":
        """The noise by the residuals of all worlds; as before where there are none."""
        white = np.array([one.white for one in equations])
        counts = white[:, :, 1].sum(axis=0)
        mean = np.sum(white[:, :, 0] * white[:, :, 1], axis=0) / np.maximum(counts, 1)
        squares, number = np.moveaxis(np.sum([one.view for one in equations], axis=0), -1, 0)
        view = np.where(number > 0, np.sqrt(squares / np.maximum(number, 1)), self.view)
        return NoiseModel(
            np.maximum(np.where(counts > 0, mean, self.white), _MIN_WHITE), np.maximum(view, _MIN_VIEW)
        )


@dataclass(frozen=True, eq=False)
class SurfaceEquations:
    """Normal equations of C numbers of the trajectory, then P of sensors, with surfaces eliminated."""

    information: Array
    """(C + P, C + P)."""
    gradient: Array
    """(C + P,)."""
    white: Array
    """(S, 2) standard deviation of residuals around patches, m, and number of points."""
    view: Array
    """(2, 2) sums of squared view biases as in :attr:`NoiseModel.view`, m², and (last axis) their number."""
    scores: "PointScores"
    """Of each point."""


@dataclass(frozen=True, eq=False)
class PointScores:
    """What each of N points contributes to the gradient."""

    derivatives: csr_array
    """(N, C + P) of its residual."""
    patch: Array
    """(N, n + 1) derivatives by its surface."""
    surface: Index
    """(N,) number of its surface."""
    force: Array
    """(N,) its residual after all that is fitted, over its variance, 1/m."""
    response: csr_array
    """(surfaces (n + 1), C + P): by how much surfaces move with trajectory and sensors."""

    def along(self, directions: Array) -> Array:
        """(N, P) contributions to the gradient along directions (C + P, P), which surfaces follow."""
        moved = (self.response @ directions).reshape(-1, self.patch.shape[1], directions.shape[1])
        change = self.derivatives @ directions - np.einsum("nj,njp->np", self.patch, moved[self.surface])
        return np.asarray(change * self.force[:, None])

    def sum_by(self, label: Index) -> Array:
        """(K, C + P) sums of all contributions by label (N,)."""
        N, n = self.patch.shape
        shape, points = (int(label.max(initial=-1)) + 1, N), np.arange(N)
        gather = csr_array((self.force, (label, points)), shape=shape)
        column = self.surface[:, None] * n + np.arange(n)
        patches = csr_array(
            (self.patch.ravel(), (np.repeat(points, n), column.ravel())), shape=(N, self.response.shape[0])
        )
        return np.asarray((gather @ self.derivatives - (gather @ patches) @ self.response).toarray())


# Start values of standard deviations, m: range noise of LiDARs, and what plaster and doors deviate from planes.
_START_WHITE, _START_VIEW = 0.02, 0.01
# Least ones: quantised ranges, and walls that are better than any.
_MIN_WHITE, _MIN_VIEW = 0.002, 0.0005
# Degrees of freedom of Student's t for view biases: a few are of furniture, or of something that moved. The fourth
# moment of those of an office is 13 to 30 times the squared second; errors with 2, 4 and many differ by 20 %.
_FREEDOM = 4.0
# By how much a surface seems nearer at grazing incidence, m: frames and shelves hide what is behind them. Without
# it, ranges seem 10 mm longer in an office than with it, and poses are 12 instead of 10 mm off.
_RELIEF = 0.02
# Views do not have another relief than their surface; exactly 0 has no information matrix.
_NO_BIAS = 1e-5
# Scale of the robust weights, in standard deviations (Geman–McClure): 99.7 % of normal errors are nearer, others
# are of something before the surface.
_ROBUST = 3.0
# Rows that are multiplied together: their columns are few, and products of this size are as fast as larger ones.
_DENSE_ROWS = 512


def eliminate_surfaces(
    at: SurfacePoints, surfaces: int, noise: NoiseModel, free: NDArray[np.bool_], controls: int
) -> SurfaceEquations:
    """The normal equations of sensors that share surfaces, and of their trajectory, from points of one world.

    Args:
        at: the points.
        surfaces: number of surfaces.
        noise: of the points.
        free: (S, Q) the parameters of sensors that are estimated.
        controls: number of control points; 0 of sensors at rest.
    """
    views = _group_points(at, len(free))
    sigma = noise.white[at.sensor]
    weight = sigma**-2.0 * _robust_weights(at, views, sigma)
    J = _arrange_derivatives(at, free, controls)
    weighted = J.multiply(np.sqrt(weight)[:, None]).tocsr()
    H = square_sparse(weighted)
    g = J.T @ (weight * at.residual)
    points = _sum_points(at, views, weight, J)
    fit = _fit_robustly(points.N, points.h, views.surface, surfaces, noise.view)
    _subtract(H, g, fit.bias_inverse, points.G, points.h)
    total = _sum_views(_without_bias(points, fit.bias_inverse), views.surface, surfaces)
    _subtract(H, g, fit.surface_inverse, total.G, total.h)
    around = at.residual - np.einsum("nj,nj->n", at.patch, (fit.surface[views.surface] + fit.bias)[views.index])
    return SurfaceEquations(
        H, g,
        _white_statistics(around, at.sensor, len(free)),
        _view_statistics(fit, views.surface, surfaces),
        PointScores(J, at.patch, at.surface, weight * around, _block_rows(fit.surface_inverse) @ total.G),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Views:
    """The V groups of points that one sensor measured on one surface within one interval."""

    index: Index
    """(N,) view of each point."""
    surface: Index
    """(V,)."""
    sensor: Index
    """(V,)."""


def _group_points(at: SurfacePoints, sensors: int) -> _Views:
    intervals = int(at.view.max(initial=0)) + 1
    keys, index = np.unique((at.surface * sensors + at.sensor) * intervals + at.view, return_inverse=True)
    return _Views(index, keys // (sensors * intervals), keys // intervals % sensors)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Surfaces and view biases that fit best."""

    surface: Array
    """(M, n + 1)."""
    surface_inverse: Array
    """(M, n + 1, n + 1) of their information, with view biases eliminated."""
    bias: Array
    """(V, n + 1)."""
    bias_inverse: Array
    """(V, n + 1, n + 1) of their information."""
    bias_variance: Array
    """(V, n + 1, n + 1) posterior, with that of surfaces."""


def _fit(N: Array, h: Array, surface: Index, count: int, information: Array) -> _Fit:
    """The surfaces (V,) and biases of views with information N (V, n+1, n+1) and gradient h (V, n+1)."""
    unit = np.eye(h.shape[1])
    bias_inverse = _invert(N + information)
    left = unit - N @ bias_inverse
    N_surface = _sum_by(surface, left @ N, count)
    # Nothing is known of a surface before; 1 m keeps cells without points solvable.
    before = np.diag([*np.ones(len(unit) - 1), _RELIEF**-2.0])
    surface_inverse = _invert(N_surface + before)
    h_surface = _sum_by(surface, np.einsum("vij,vj->vi", left, h), count)
    fitted = np.einsum("mij,mj->mi", surface_inverse, h_surface)
    bias = np.einsum("vij,vj->vi", bias_inverse, h - np.einsum("vij,vj->vi", N, fitted[surface]))
    share = bias_inverse @ N
    variance = bias_inverse + share @ surface_inverse[surface] @ se_n.transpose(share)
    return _Fit(fitted, surface_inverse, bias, bias_inverse, variance)


def _fit_robustly(N: Array, h: Array, surface: Index, count: int, stddev: Array) -> _Fit:
    """The fit whose information is smaller for biases that are large: Student's t by reweighting."""
    n = h.shape[1]
    by_axis = np.array([stddev[0], *[stddev[1]] * (n - 2), _NO_BIAS])
    fit = _fit(N, h, surface, count, np.diag(by_axis**-2.0))
    for _ in range(3):
        scale = (_FREEDOM + n) / (_FREEDOM + np.sum((fit.bias / by_axis) ** 2, axis=1))
        fit = _fit(N, h, surface, count, scale[:, None, None] * np.diag(by_axis**-2.0))
    return fit


def _sum_by(parent: Index, values: Array, count: int) -> Array:
    """Sums of values (M, ...) with the same parent."""
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, parent, values)
    return sums


def _arrange_derivatives(at: SurfacePoints, free: NDArray[np.bool_], controls: int) -> csr_array:
    """(N, C + P) derivatives of residuals by control points, then by the free parameters of sensors."""
    width = at.by_control.shape[1] // 4
    number = np.full(free.shape, -1)
    number[free] = np.arange(free.sum())
    rows = np.arange(len(at.residual))
    control_columns = at.first[:, None] * width + np.arange(4 * width)
    sensor_columns = number[at.sensor]
    used = sensor_columns >= 0
    return csr_array(
        (
            np.concatenate([at.by_control.ravel(), at.by_sensor[used]]),
            (
                np.concatenate([np.repeat(rows, 4 * width), np.nonzero(used)[0]]),
                np.concatenate([control_columns.ravel(), controls * width + sensor_columns[used]]),
            ),
        ),
        shape=(len(rows), controls * width + int(free.sum())),
    )


@dataclass(frozen=True, eq=False)
class _Moments:
    """Normal equations of M patches: residual - patch · x, with derivatives of the residual by what remains."""

    N: Array
    """(M, n + 1, n + 1) information of each patch."""
    h: Array
    """(M, n + 1) and its gradient."""
    G: csr_array
    """(M (n + 1), C + P) information between patches and what remains."""


def _sum_points(at: SurfacePoints, views: _Views, weight: Array, J: csr_array) -> _Moments:
    count, n = len(views.surface), at.patch.shape[1]
    patches = csr_array(
        (
            (at.patch * weight[:, None]).ravel(),
            ((views.index[:, None] * n + np.arange(n)).ravel(), np.repeat(np.arange(len(weight)), n)),
        ),
        shape=(count * n, len(weight)),
    )
    N = np.empty((count, n, n))
    for a in range(n):
        for b in range(n):
            N[:, a, b] = np.bincount(views.index, weight * at.patch[:, a] * at.patch[:, b], count)
    return _Moments(N, (patches @ at.residual).reshape(-1, n), patches @ J)


def _without_bias(moments: _Moments, inverse: Array) -> _Moments:
    """What is left of the equations of patches when a bias of each is eliminated."""
    share = moments.N @ inverse
    return _Moments(
        moments.N - share @ moments.N,
        moments.h - np.einsum("gij,gj->gi", share, moments.h),
        moments.G - _block_rows(share) @ moments.G,
    )


def _sum_views(left: _Moments, surface: Index, count: int) -> _Moments:
    """Sums over the views of each surface."""
    n = left.h.shape[1]
    size = left.h.size
    rows = (surface[:, None] * n + np.arange(n)).ravel()
    gather = csr_array((np.ones(size), (rows, np.arange(size))), shape=(count * n, size))
    return _Moments(_sum_by(surface, left.N, count), _sum_by(surface, left.h, count), gather @ left.G)


def _subtract(H: Array, g: Array, inverse: Array, G: csr_array, h: Array) -> None:
    """Subtracts what unknown patches take from normal equations (Schur complement), in place.

    Args:
        H: (C + P, C + P).
        g: (C + P,).
        inverse: (M, n, n) of the information of the patches.
        G: (M n, C + P).
        h: (M, n).
    """
    root = np.asarray(np.linalg.cholesky(inverse), dtype=np.float64)
    F = _block_rows(se_n.transpose(root)) @ G
    H -= square_sparse(F)
    g -= G.T @ np.einsum("gij,gj->gi", inverse, h).ravel()


def square_sparse(F: csr_array) -> Array:
    """(C, C) Fᵀ F of a matrix (R, C) whose rows have their columns close together.

    Rows of neighbouring columns are multiplied together as dense ones, 12 to 28 times faster than sparse products:
    points of one second depend on the control points of that second.
    """
    lengths = np.diff(F.indptr)
    rows = np.flatnonzero(lengths)
    rows = rows[np.argsort(np.minimum.reduceat(F.indices, F.indptr[rows]), kind="stable")] if len(rows) else rows
    square = np.zeros((F.shape[1],) * 2)
    number = np.zeros(F.shape[1], dtype=np.intp)
    for first in range(0, len(rows), _DENSE_ROWS):
        some = F[rows[first : first + _DENSE_ROWS]]
        columns = np.flatnonzero(np.bincount(some.indices, minlength=F.shape[1]))
        number[columns] = np.arange(len(columns))
        dense = np.zeros((some.shape[0], len(columns)))
        dense[np.repeat(np.arange(some.shape[0]), np.diff(some.indptr)), number[some.indices]] = some.data
        square[np.ix_(columns, columns)] += dense.T @ dense
    return square


def _robust_weights(at: SurfacePoints, views: _Views, sigma: Array) -> Array:
    """(N,) Geman–McClure weights of the distances from the median of each view's points."""
    order = np.lexsort((at.residual, views.index))
    sizes = np.bincount(views.index)
    middle = np.cumsum(sizes) - sizes + sizes // 2
    center = at.residual[order][middle]
    scaled = (at.residual - center[views.index]) / (_ROBUST * sigma)
    return np.asarray((1 + scaled**2) ** -2.0)


def _white_statistics(around: Array, sensor: Index, sensors: int) -> Array:
    """(S, 2) standard deviations of residuals around their patches, m, and numbers of points."""
    white = np.zeros((sensors, 2))
    for k in range(sensors):
        of_sensor = sensor == k
        if of_sensor.any():
            white[k] = STDDEV_PER_MAD * np.median(np.abs(around[of_sensor])), of_sensor.sum()
    return white


def _view_statistics(fit: _Fit, surface: Index, count: int) -> Array:
    """(2, 2) expected squared view biases, and their number, of surfaces in several views (EM)."""
    several = np.bincount(surface, minlength=count)[surface] > 1
    expected = fit.bias[several] ** 2 + np.diagonal(fit.bias_variance[several], axis1=-2, axis2=-1)
    return np.array([[some.sum(), some.size] for some in (expected[:, :1], expected[:, 1:-1])])


def _invert(matrices: Array) -> Array:
    """Inverses of matrices (..., n, n)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _block_rows(blocks: Array) -> csr_array:
    """The block-diagonal matrix of blocks (B, n, n)."""
    B, n, _ = blocks.shape
    base = np.arange(B)[:, None, None] * n
    row = np.broadcast_to(base + np.arange(n)[:, None], blocks.shape)
    column = np.broadcast_to(base + np.arange(n), blocks.shape)
    return csr_array((blocks.ravel(), (row.ravel(), column.ravel())), shape=(B * n, B * n))

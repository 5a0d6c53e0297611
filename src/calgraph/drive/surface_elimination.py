"""Elimination of surfaces: normal equations of trajectory and sensors from the points of a part of a drive.

Points of one sensor on one surface within a second are a group. Each group has a view bias, each surface a flat
patch; both are linear in the residuals and are eliminated in closed form, groups first.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from calgraph.drive.surface_points import SurfacePoints
from calgraph.geometry import STDDEV_PER_MAD, Array, Index, se_n


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Standard deviations of residuals."""

    white: Array
    """(S,) of each point of a sensor along the normal, m."""
    view: float
    """Of the offset of a patch as one sensor measures it, and of its slopes at one standard deviation of the
    points from the middle, m."""


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
    """(2,) sum of squared view biases, m², and their number."""
    shared: Array
    """(S, S) number of surfaces that both sensors measured."""


# Degrees of freedom of Student's t for view biases: a few are of furniture, or of something that moved. The fourth
# moment of those of an office is 13 to 30 times the squared second; errors with 2, 4 and many differ by 20 %.
_FREEDOM = 4.0
# Scale of the robust weights, in standard deviations (Geman–McClure): 99.7 % of normal errors are nearer, others
# are of something before the surface.
_ROBUST = 3.0


def eliminate_surfaces(
    at: SurfacePoints, surfaces: int, noise: NoiseModel, free: NDArray[np.bool_], controls: int
) -> SurfaceEquations:
    """The normal equations of a part of the drive from its points.

    Args:
        at: the points.
        surfaces: number of surfaces.
        noise: of the points.
        free: (S, n + d + 3) the parameters of sensors that are estimated.
        controls: number of control points.
    """
    groups = _group_points(at, len(free))
    sigma = noise.white[at.sensor]
    weight = sigma**-2.0 * _robust_weights(at, groups, sigma)
    J = _arrange_derivatives(at, free, controls)
    weighted = J.multiply(np.sqrt(weight)[:, None]).tocsr()
    H = (weighted.T @ weighted).toarray()
    g = J.T @ (weight * at.residual)
    points = _sum_groups(at, groups, weight, J)
    view = _view_information(points.N, points.h, groups.surface, surfaces, noise.view)
    inverse = _invert(points.N + view)
    # View biases, which are as many as groups.
    _subtract(H, g, inverse, points.G, points.h)
    # Of what a surface would be moved by, its views' biases take this share.
    share = points.N @ inverse
    left = _Moments(
        points.N - share @ points.N,
        points.h - np.einsum("gij,gj->gi", share, points.h),
        points.G - _block_rows(share) @ points.G,
    )
    total = _sum_surfaces(left, groups.surface, surfaces)
    # Nothing is known of a surface before; 1 m keeps cells without points solvable.
    surface_inverse = _invert(total.N + np.eye(total.N.shape[-1]))
    _subtract(H, g, surface_inverse, total.G, total.h)
    # Statistics of the noise, with the patches that are fitted at this linearization.
    fitted = np.einsum("gij,gj->gi", surface_inverse, total.h)[groups.surface]
    bias = np.einsum("gij,gj->gi", inverse, points.h - np.einsum("gij,gj->gi", points.N, fitted))
    around = at.residual - np.einsum("nj,nj->n", at.patch, (fitted + bias)[groups.index])
    # Posterior variance of a bias: given the surface, and of the surface.
    variance = inverse + np.swapaxes(share, -1, -2) @ surface_inverse[groups.surface] @ share
    return SurfaceEquations(
        H, g,
        _white_statistics(around, at.sensor, len(free)),
        _view_statistics(groups.surface, bias, variance, surfaces),
        _count_shared(groups, len(free), surfaces),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Groups:
    """The G groups of points that one sensor measured on one surface within one interval."""

    index: Index
    """(N,) group of each point."""
    surface: Index
    """(G,)."""
    sensor: Index
    """(G,)."""


def _group_points(at: SurfacePoints, sensors: int) -> _Groups:
    views = int(at.view.max(initial=0)) + 1
    keys, index = np.unique((at.surface * sensors + at.sensor) * views + at.view, return_inverse=True)
    return _Groups(index, keys // (sensors * views), keys // views % sensors)


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
    """(M, n, n) information of each patch."""
    h: Array
    """(M, n) and its gradient."""
    G: csr_array
    """(M n, C + P) information between patches and what remains."""


def _sum_groups(at: SurfacePoints, groups: _Groups, weight: Array, J: csr_array) -> _Moments:
    count, n = len(groups.surface), at.patch.shape[1]
    patches = csr_array(
        (
            (at.patch * weight[:, None]).ravel(),
            ((groups.index[:, None] * n + np.arange(n)).ravel(), np.repeat(np.arange(len(weight)), n)),
        ),
        shape=(count * n, len(weight)),
    )
    N = np.empty((count, n, n))
    for a in range(n):
        for b in range(n):
            N[:, a, b] = np.bincount(groups.index, weight * at.patch[:, a] * at.patch[:, b], count)
    return _Moments(N, (patches @ at.residual).reshape(-1, n), patches @ J)


def _sum_surfaces(left: _Moments, surface: Index, count: int) -> _Moments:
    """Sums over the groups of each surface."""
    n = left.h.shape[1]
    N, h = np.zeros((count, n, n)), np.zeros((count, n))
    np.add.at(N, surface, left.N)
    np.add.at(h, surface, left.h)
    size = left.h.size
    rows = (surface[:, None] * n + np.arange(n)).ravel()
    gather = csr_array((np.ones(size), (rows, np.arange(size))), shape=(count * n, size))
    return _Moments(N, h, gather @ left.G)


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
    H -= (F.T @ F).toarray()
    g -= G.T @ np.einsum("gij,gj->gi", inverse, h).ravel()


def _robust_weights(at: SurfacePoints, groups: _Groups, sigma: Array) -> Array:
    """(N,) Geman–McClure weights of the distances from the median of each group's points."""
    order = np.lexsort((at.residual, groups.index))
    sizes = np.bincount(groups.index)
    middle = np.cumsum(sizes) - sizes + sizes // 2
    center = at.residual[order][middle]
    scaled = (at.residual - center[groups.index]) / (_ROBUST * sigma)
    return np.asarray((1 + scaled**2) ** -2.0)


def _view_information(N: Array, h: Array, surface: Index, count: int, stddev: float) -> Array:
    """(G, n, n) information of view biases, smaller for those that are large: Student's t by reweighting.

    Args:
        N: (G, n, n) information of the points on the patch of each group.
        h: (G, n) and its gradient.
        surface: (G,) of each group.
        count: number of surfaces.
        stddev: of most biases, m.
    """
    n = h.shape[1]
    scale = np.ones(len(h))
    information = np.eye(n) * stddev**-2.0
    for _ in range(3):
        inverse = _invert(N + scale[:, None, None] * information)
        left = np.eye(n) - N @ inverse
        N_surface, h_surface = np.zeros((count, n, n)), np.zeros((count, n))
        np.add.at(N_surface, surface, left @ N)
        np.add.at(h_surface, surface, np.einsum("gij,gj->gi", left, h))
        fitted = np.linalg.solve(N_surface + np.eye(n), h_surface[..., None])[surface, :, 0]
        bias = np.einsum("gij,gj->gi", inverse, h - np.einsum("gij,gj->gi", N, fitted))
        scale = (_FREEDOM + n) / (_FREEDOM + np.sum(bias**2, axis=1) / stddev**2)
    return np.asarray(scale[:, None, None] * information)


def _white_statistics(around: Array, sensor: Index, sensors: int) -> Array:
    """(S, 2) standard deviations of residuals around their patches, m, and numbers of points."""
    white = np.zeros((sensors, 2))
    for k in range(sensors):
        of_sensor = sensor == k
        if of_sensor.any():
            white[k] = STDDEV_PER_MAD * np.median(np.abs(around[of_sensor])), of_sensor.sum()
    return white


def _view_statistics(surface: Index, bias: Array, variance: Array, count: int) -> Array:
    """(2,) expected squared view biases, and their number, of surfaces in several views (EM)."""
    several = np.bincount(surface, minlength=count)[surface] > 1
    expected = bias[several] ** 2 + np.diagonal(variance[several], axis1=-2, axis2=-1)
    return np.array([expected.sum(), expected.size])


def _count_shared(groups: _Groups, sensors: int, surfaces: int) -> Array:
    """(S, S) number of surfaces that both sensors measured."""
    measured = np.zeros((sensors, surfaces))
    measured[groups.sensor, groups.surface] = 1
    return np.asarray(measured @ measured.T)


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

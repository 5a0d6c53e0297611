"""The surroundings as one flat patch for each cell of a grid: planes in space, lines in the plane (n = 3 or 2).

Cells keep moments of the points within them, which add up over sweeps; the patch is the principal component
(Pearson, "On lines and planes of closest fit to systems of points in space", 1901).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.geometry import Array, Index

# Cells within 2^20 of the origin along each axis have keys of 63 bits: 500 km of cells of 0.5 m.
_KEY_BITS = 21


@dataclass(frozen=True, eq=False)
class CellMoments:
    """Sums over the points in each cell, by ascending key."""

    keys: NDArray[np.int64]
    """(M,)."""
    count: Array
    """(M,) number of points."""
    first: Array
    """(M, n) sum of the points, m."""
    second: Array
    """(M, n, n) sum of their outer products, m²."""

    @property
    def mean(self) -> Array:
        """(M, n) centres of the points, m."""
        return self.first / self.count[:, None]

    @cached_property
    def principal(self) -> tuple[Array, Array]:
        """Variances (M, n), m², ascending, and their axes (M, n, n) in columns."""
        mean = self.mean
        covariance = self.second / self.count[:, None, None] - mean[:, :, None] * mean[:, None, :]
        values, vectors = np.linalg.eigh(covariance)
        return np.maximum(values, 0), vectors


def sum_moments(points: Array, cell: float) -> CellMoments:
    """Moments of points (N, n) in cells of an edge length, m."""
    keys, index = np.unique(cell_keys(points, cell), return_inverse=True)
    size, n = len(keys), points.shape[1]
    second = np.empty((size, n, n))
    for i in range(n):
        for j in range(i, n):
            second[:, i, j] = second[:, j, i] = np.bincount(index, points[:, i] * points[:, j], size)
    first = np.stack([np.bincount(index, points[:, i], size) for i in range(n)], axis=1)
    count = np.bincount(index, minlength=size).astype(np.float64)
    return CellMoments(keys, count, np.asarray(first, dtype=np.float64), second)


def sum_moments_within(points: Array, group: Index, cell: float) -> CellMoments:
    """Moments of points (N, n) in cells whose scatter is that of the points of each group (N,) about its mean."""
    total = sum_moments(points, cell)
    of_cell = np.searchsorted(total.keys, cell_keys(points, cell))
    _, number = np.unique(of_cell * (int(group.max(initial=0)) + 1) + group, return_inverse=True)
    count, n = np.bincount(number), points.shape[1]
    mean = np.stack([np.bincount(number, points[:, i]) / count for i in range(n)], axis=1)
    off = points - mean[number]
    second = total.first[:, :, None] * total.mean[:, None, :]
    for i in range(n):
        for j in range(n):
            second[:, i, j] += np.bincount(of_cell, off[:, i] * off[:, j], len(second))
    return CellMoments(total.keys, total.count, total.first, second)


def merge_moments(parts: Sequence[CellMoments]) -> CellMoments:
    """The moments of the points of all parts, whose cells have the same size."""
    keys, index = np.unique(np.concatenate([part.keys for part in parts]), return_inverse=True)
    n = parts[0].first.shape[1]
    rows = np.concatenate(
        [np.column_stack([p.count, p.first, p.second.reshape(len(p.keys), n * n)]) for p in parts]
    )
    columns = [np.bincount(index, column, len(keys)) for column in rows.T]
    sums = np.stack(columns, axis=1).astype(np.float64, copy=False)
    return CellMoments(keys, sums[:, 0], sums[:, 1 : n + 1], sums[:, n + 1 :].reshape(-1, n, n))


def cell_keys(points: Array, cell: float) -> NDArray[np.int64]:
    """(N,) the keys of the cells of points (N, n)."""
    at = np.floor(points / cell).astype(np.int64) + (1 << (_KEY_BITS - 1))
    keys = at[:, 0]
    for axis in range(1, points.shape[1]):
        keys = (keys << _KEY_BITS) | at[:, axis]
    return keys


@dataclass(frozen=True)
class CellLimits:
    """What counts as a surface, besides its thickness."""

    cell: float
    """Edge length of the cells, m."""
    min_count: int
    """Least number of points in a cell."""
    min_extent: float
    """Least standard deviation along each direction of the surface, m."""


@dataclass(frozen=True, eq=False)
class FlatCells:
    """The cells whose points lie on a plane, or in 2-D on a line, by ascending key."""

    cell: float
    """Edge length of the cells, m."""
    keys: NDArray[np.int64]
    """(M,)."""
    center: Array
    """(M, n) mean of the points, m."""
    axes: Array
    """(M, n, n) the unit normal, then directions along the surface, in columns."""
    thickness: Array
    """(M,) standard deviation of the points along the normal, m."""
    extent: Array
    """(M, n - 1) standard deviations along the surface, ascending, m."""
    count: Array
    """(M,) number of points."""

    @property
    def normals(self) -> Array:
        """(M, n)."""
        return self.axes[:, :, 0]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.center)

    def find_near(self, points: Array, max_distance: float) -> Index:
        """(N,) the flat cell that each point (N, n) is in, or else the one whose centre is nearest to it.

        -1 if none is within a distance, m.
        """
        index = self.find(points)
        outside = np.flatnonzero(index < 0)
        if len(outside) and len(self.keys):
            distance, nearest = self._tree.query(points[outside], distance_upper_bound=max_distance)
            index[outside] = np.where(np.isfinite(distance), nearest, -1)
        return index

    def find(self, points: Array) -> Index:
        """(N,) the flat cell that each point (N, n) is in; -1 for none."""
        if not len(self.keys):
            return np.full(len(points), -1, dtype=np.intp)
        keys = cell_keys(points, self.cell)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[at] == keys, at, -1)


def fit_flat_cells(moments: CellMoments, limits: CellLimits, max_thickness: float) -> FlatCells:
    """The cells of moments that are flat: points along the normal have a standard deviation of this at most, m."""
    values, vectors = moments.principal
    flat = (moments.count >= limits.min_count) & (values[:, 0] <= max_thickness**2)
    flat &= values[:, 1] >= limits.min_extent**2
    return FlatCells(
        limits.cell,
        moments.keys[flat],
        moments.mean[flat],
        vectors[flat],
        np.sqrt(values[flat, 0]),
        np.sqrt(values[flat, 1:]),
        moments.count[flat],
    )

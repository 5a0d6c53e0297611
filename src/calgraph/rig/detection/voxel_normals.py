"""Downsampling of a cloud to direction cells of even spacing, and their normals.

Multi-beam scanners measure every few millimetres along a ring and every few decimetres across: the nearest points
lie on one line, which has no normal. Averages over direction cells are evenly spaced and less noisy, and the time
is independent of the number of points.
"""

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array, measure_lengths, plane

Indices = NDArray[np.intp]

# Least cosine of an elevation by which the width of a cell is divided: keeps it finite at the poles.
_MIN_POLE_COSINE = 0.02


@dataclass(frozen=True, eq=False)
class Cells:
    """Direction cells, each with the mean of its points."""

    points: Array
    """(M, 3) m."""
    cell_of_point: Indices
    """(N,) cell of each point of the cloud; -1 where the cell was dropped as an outlier."""
    spacing: float
    """Angle between neighbouring cells in the direction in which they are sparser, rad."""
    neighbours: Indices
    """(M, K) cells near each cell, itself first; -1 where there are fewer."""
    normals: Array
    """(M, 3) unit normals, towards the sensor; zero where the neighbours lie on a line."""
    curvature: Array
    """(M,) share of the neighbours' scatter along the normal: 0 is flat, 1/3 is round, inf has no normal."""


# Percentile of the steps between rings that is their spacing: LiDARs have denser rings near the horizon.
_RING_SPACING_PERCENTILE = 75.0
# Edge of a direction cell, 0.7°: 12 mm at one metre and 8 cells across a board of 0.6 m at 6 m.
_CELL_ANGLE = math.radians(0.7)
# Minimum width of a cell along a sparse ring, 0.4°; wider ones have a third of the spacing of rings.
_MIN_RING_CELL_ANGLE = math.radians(0.4)
# Cells along a sparse ring for its spacing: normals need several along a ring where there are few rings.
_RING_CELLS = 3.0
# Minimum number of neighbours of a normal; three lie on a plane by chance. Cells with fewer are stray.
_MIN_NEIGHBOURS = 5
# Neighbours of a cell from which its normal is computed: two rings of a square grid hold 24.
_NEIGHBOURS = 16
# The same where rings are sparse: cells are three times as dense along a ring as across.
_RING_NEIGHBOURS = 24
# Maximum distance of neighbours, in spacings of cells: beyond it they are of other surfaces, or stray.
_NEIGHBOUR_REACH = 3.0


def make_cells(points: Array, rings: NDArray[np.int32] | None, settings: DetectionSettings) -> Cells | None:
    """Averages points (N, 3) in cells, removes stray cells and finds normals; None if too few are left."""
    levels = _find_ring_elevations(points, rings)
    across = float(np.percentile(np.diff(levels), _RING_SPACING_PERCENTILE)) if levels is not None else _CELL_ANGLE
    along = max(_MIN_RING_CELL_ANGLE, across / _RING_CELLS) if levels is not None else _CELL_ANGLE
    # Points of one direction cell whose ranges differ by a depth jump are on two surfaces.
    cell = _assign_cells(points, levels, along, settings.scanner.min_depth_jump)
    count = np.bincount(cell)
    means = np.stack([np.bincount(cell, along_axis) / count for along_axis in points.T], axis=-1)
    if len(means) <= _MIN_NEIGHBOURS:
        return None
    radius = measure_lengths(means)
    k = min(_NEIGHBOURS if levels is None else _RING_NEIGHBOURS, len(means))
    distance, neighbours = cKDTree(means, balanced_tree=False).query(means, k=k)
    # On a square grid the eighth neighbour is a diagonal away; the scan planes of a slow spinner are sparser.
    spacing = max(across, along, float(np.median(distance[:, min(8, k - 1)] / radius)) / np.sqrt(2))
    near = distance <= _NEIGHBOUR_REACH * spacing * radius[:, None]
    keep = _select_inlier_cells(distance / radius[:, None], near)
    if keep.sum() <= _MIN_NEIGHBOURS:
        return None
    new_index = np.where(keep, np.cumsum(keep) - 1, -1)
    neighbours = np.where(near, new_index[neighbours], -1)[keep]
    normals, curvature = _estimate_normals(means[keep], neighbours)
    return Cells(means[keep], new_index[cell], spacing, neighbours, normals, curvature)


# Bin of the histogram of elevations by which rings without numbers are found, rad (0.1°): the spread within a
# ring.
_ELEVATION_BIN = math.radians(0.1)
# Minimum share of all points in a bin of a ring: a ring of 128 has a share of 8e-3, bins of stray points far
# less.
_MIN_RING_SHARE = 2e-4
# Minimum elevation between two rings, rad (0.05°): half of that of the densest LiDARs; closer ones are one.
_MIN_RING_STEP = math.radians(0.05)
# Rings are sparse if their spacing is at least this many cells: below, square cells hold points of several rings.
_SPARSE_RING_RATIO = 1.5


def _find_ring_elevations(points: Array, rings: NDArray[np.int32] | None) -> Array | None:
    """Ascending elevations of the rings of a multi-beam scanner, rad; None if the scanner has no sparse rings."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    if rings is not None:
        levels = np.sort([np.median(elevation[rings == ring]) for ring in np.unique(rings)])
    else:
        # The histogram of elevations of a multi-beam scanner has few narrow peaks.
        bins = np.floor(elevation / _ELEVATION_BIN).astype(np.int64)
        values, count = np.unique(bins, return_counts=True)
        values = values[count > _MIN_RING_SHARE * len(points)]
        peaks = np.split(values, np.flatnonzero(np.diff(values) > 1) + 1)
        levels = np.array([_ELEVATION_BIN * (peak.mean() + 0.5) for peak in peaks if len(peak)])
    levels = levels[np.append(True, np.diff(levels) > _MIN_RING_STEP)] if len(levels) else levels
    if len(levels) < 2:
        return None
    spacing = np.percentile(np.diff(levels), _RING_SPACING_PERCENTILE)
    if spacing < _SPARSE_RING_RATIO * _CELL_ANGLE:
        return None
    return np.asarray(levels)


def _assign_cells(points: Array, levels: Array | None, along: float, depth_step: float) -> Indices:
    """Index 0..M-1 of the cell of each point."""
    radius = measure_lengths(points)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    if levels is None:
        row = np.floor((elevation + np.pi) / along).astype(np.int64)
    else:
        row = np.searchsorted(0.5 * (levels[1:] + levels[:-1]), elevation)
    # Cells keep their width towards the poles.
    width = along / np.maximum(np.cos(row * along - np.pi if levels is None else levels[row]), _MIN_POLE_COSINE)
    column = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / width).astype(np.int64)
    depth = np.floor(radius / depth_step).astype(np.int64)
    _, cell = np.unique((row << 40) | (column << 24) | np.minimum(depth, 2**24 - 1), return_inverse=True)
    return np.asarray(cell).ravel()


# Cells whose mean distance to their neighbours exceeds the usual one by more standard deviations are stray
# (statistical outlier removal, MSG-Cal, section III-B).
_STRAY_SIGMAS = 3.0


def _select_inlier_cells(relative: Array, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Statistical outlier removal (MSG-Cal, III-B) on distances relative to range, as density falls with it."""
    mean = relative.mean(axis=1)
    enough: NDArray[np.bool_] = np.asarray(near.sum(axis=1) > _MIN_NEIGHBOURS)
    if not enough.any():
        return enough
    usual = mean[enough]
    return np.asarray(enough & (mean < usual.mean() + _STRAY_SIGMAS * usual.std() + 1e-9))


# Minimum ratio of the neighbours' scatter across and along their longest direction, for a normal: those of one
# ring lie on a line.
_MIN_WIDTH_RATIO = 0.02


def _estimate_normals(points: Array, neighbours: Indices) -> tuple[Array, Array]:
    valid = neighbours >= 0
    count = np.maximum(valid.sum(axis=1), 1)
    itself = np.arange(len(points))[:, None]
    neighbours = np.where(valid, neighbours, itself)
    # Offsets (M, K) along one axis at a time: sums over the short axis of (M, K, 3) take three times as long.
    offsets = [along[neighbours] - along[:, None] for along in np.ascontiguousarray(points.T)]
    means = [along.sum(axis=1) / count for along in offsets]
    scatter = np.empty((len(points), 3, 3))
    for i, j in combinations_with_replacement(range(3), 2):
        products = np.einsum("nk,nk->n", offsets[i], offsets[j])
        scatter[:, i, j] = scatter[:, j, i] = products / count - means[i] * means[j]
    values, vectors = np.linalg.eigh(scatter)
    normals = vectors[..., 0]
    normals *= -np.sign(np.sum(normals * points, axis=1, keepdims=True))
    line = (values[:, 1] < _MIN_WIDTH_RATIO * values[:, 2]) | (count <= _MIN_NEIGHBOURS)
    curvature = np.where(line, np.inf, np.maximum(values[:, 0], 0) / np.maximum(values.sum(axis=1), 1e-12))
    return np.where(line[:, None], 0, normals), curvature


# Maximum angle between a cell's normal and its region's plane, 35°: normals from few rings are that noisy.
_MAX_NORMAL_ANGLE = math.radians(35.0)
# Minimum number of cells of a region: a plane, and five residuals.
_MIN_CELLS = 8
# Growth of a region after which its plane is fitted again: its normal is then a sixth more accurate.
_REFIT_GROWTH = 1.2
# Maximum share of the scatter along the normal at the seed of a region; a plane has 0, a sphere 1/3.
_MAX_CURVATURE = 0.08


def grow_flat_regions(cells: Cells, thickness: float) -> list[Indices]:
    """Cells of each flat region, the region with the flattest seed first.

    Args:
        cells: the cloud.
        thickness: largest distance of cells from their region's plane, m.
    """
    # Hundreds of small regions are grown and dropped in each cloud: calls of NumPy are what takes time here.
    surfels = np.concatenate([cells.points, cells.normals], axis=1)
    # The last entry is that of index -1, which fills rows of cells with fewer neighbours.
    free = np.append(np.ones(len(surfels), dtype=np.bool_), False)
    min_cosine = math.cos(_MAX_NORMAL_ANGLE)

    def lies_on_plane(index: Indices, surface: Array) -> NDArray[np.bool_]:
        chosen = surfels.take(index, axis=0)
        near = np.abs(chosen[:, :3] @ surface[:3] + surface[3]) < thickness
        # A cell at an edge has no normal (zero).
        along = np.abs(chosen[:, 3:] @ surface[:3])
        return np.asarray(near & ((along > min_cosine) | (along == 0)))

    def grow_region(seed: int) -> Indices:
        """Cells of the region of a seed, in ascending order; none if there are too few."""
        around = cells.neighbours[seed]
        n = cells.normals[seed]
        surface = np.append(n, -n @ cells.points[around[around >= 0]].mean(axis=0))
        frontier = members = np.array([seed])
        free[seed] = False
        fitted = 1
        while len(frontier):
            around = cells.neighbours[frontier]
            reached = _sort_distinct(around[free[around]])
            frontier = reached[lies_on_plane(reached, surface)]
            free[frontier] = False
            members = np.concatenate([members, frontier])
            if len(members) >= max(_MIN_CELLS, _REFIT_GROWTH * fitted):
                surface, fitted = plane.fit(cells.points[np.sort(members)]), len(members)
        free[members] = True
        if len(members) < _MIN_CELLS:
            return members[:0]
        # The plane moved while the region grew: cells that joined early may be off it.
        members.sort()
        kept = members[lies_on_plane(members, surface)]
        return kept if len(kept) >= _MIN_CELLS else kept[:0]

    seeds = np.argsort(cells.curvature, kind="stable")
    regions = []
    for seed in seeds[cells.curvature[seeds] <= _MAX_CURVATURE].tolist():
        if free[seed]:
            region = grow_region(seed)
            free[seed] = False
            free[region] = False
            if len(region):
                regions.append(region)
    return regions


def _sort_distinct(indices: Indices) -> Indices:
    """The distinct indices in ascending order; ``np.unique`` takes twice as long for a few."""
    ordered = np.sort(indices)
    first = np.ones(len(ordered), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=first[1:])
    return ordered[first]

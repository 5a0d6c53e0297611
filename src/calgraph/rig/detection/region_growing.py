"""Flat regions of a cloud, grown from seeds of least curvature.

Source: MSG-Cal, section III-B (regions seeded at minimum curvature). Cells join by their distance from the
region's plane, refitted as it grows: single normals are too noisy on a cloud of few rings.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, plane
from calgraph.rig.detection.voxel_normals import Cells, Indices

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

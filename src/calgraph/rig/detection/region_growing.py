"""Flat regions of a cloud, grown from seeds of least curvature.

Source: MSG-Cal, section III-B (regions seeded at minimum curvature). Cells join by their distance from the
region's plane, refitted as it grows: single normals are too noisy on a cloud of few rings.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import RegionSettings
from calgraph.geometry import Array, plane
from calgraph.rig.detection.voxel_normals import Cells, Indices


def grow_flat_regions(cells: Cells, thickness: float, settings: RegionSettings) -> list[Indices]:
    """Cells of each flat region, the region with the flattest seed first.

    Args:
        cells: the cloud.
        thickness: largest distance of cells from their region's plane, m.
        settings: of regions.
    """
    # Hundreds of small regions are grown and dropped in each cloud: calls of NumPy are what takes time here.
    surfels = np.concatenate([cells.points, cells.normals], axis=1)
    # The last entry is that of index -1, which fills rows of cells with fewer neighbours.
    free = np.append(np.ones(len(surfels), dtype=np.bool_), False)
    min_cosine = math.cos(settings.max_normal_angle)

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
            if len(members) >= max(settings.min_cells, settings.refit_growth * fitted):
                surface, fitted = plane.fit(cells.points[np.sort(members)]), len(members)
        free[members] = True
        if len(members) < settings.min_cells:
            return members[:0]
        # The plane moved while the region grew: cells that joined early may be off it.
        members.sort()
        kept = members[lies_on_plane(members, surface)]
        return kept if len(kept) >= settings.min_cells else kept[:0]

    seeds = np.argsort(cells.curvature, kind="stable")
    regions = []
    for seed in seeds[cells.curvature[seeds] <= settings.max_curvature].tolist():
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

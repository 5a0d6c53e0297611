"""Flat regions of a cloud, grown from seeds of least curvature.

Source: MSG-Cal, section III-B (regions seeded at minimum curvature). Cells join by their distance from the
region's plane, refitted as it grows: single normals are too noisy on a cloud of few rings.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import RegionSettings
from calgraph.detection.voxel_normals import Cells, Indices
from calgraph.geometry import Array, plane


def grow_flat_regions(cells: Cells, thickness: float, settings: RegionSettings) -> list[Indices]:
    """Cells of each flat region, the region with the flattest seed first.

    Args:
        cells: the cloud.
        thickness: largest distance of cells from their region's plane, m.
        settings: of regions.
    """
    free = np.ones(len(cells.points), dtype=bool)
    regions = []
    for seed in np.argsort(cells.curvature, kind="stable"):
        if cells.curvature[seed] > settings.max_curvature:
            break
        if not free[seed]:
            continue
        region = _grow_region(cells, int(seed), free, thickness, settings)
        free[seed] = False
        if len(region) >= settings.min_cells:
            free[region] = False
            regions.append(region)
    return regions


def _grow_region(
    cells: Cells, seed: int, free: NDArray[np.bool_], thickness: float, settings: RegionSettings
) -> Indices:
    n = cells.normals[seed]
    around = cells.neighbours[seed]
    around = around[around >= 0]
    surface = np.append(n, -n @ cells.points[around].mean(axis=0))
    inside = np.zeros(len(free), dtype=bool)
    inside[seed] = True
    size, fitted = 1, 1
    frontier = np.array([seed])
    while len(frontier):
        around = cells.neighbours[frontier]
        touched = np.zeros(len(free), dtype=bool)
        touched[around[around >= 0]] = True
        reached = np.flatnonzero(touched & free & ~inside)
        joins = _lies_on_plane(cells, reached, surface, thickness, settings)
        frontier = reached[joins]
        inside[frontier] = True
        size += len(frontier)
        if size >= max(settings.min_cells, settings.refit_growth * fitted):
            surface, fitted = plane.fit(cells.points[inside]), size
    members = np.flatnonzero(inside)
    # The plane moved while the region grew: cells that joined early may be off it.
    return members[_lies_on_plane(cells, members, surface, thickness, settings)]


def _lies_on_plane(
    cells: Cells, index: Indices, surface: Array, thickness: float, settings: RegionSettings
) -> NDArray[np.bool_]:
    near = np.abs(plane.distance(surface, cells.points[index])) < thickness
    # A cell at an edge has no normal (zero).
    along = np.abs(cells.normals[index] @ surface[:3])
    return np.asarray(near & ((along > np.cos(settings.max_normal_angle)) | (along == 0)))

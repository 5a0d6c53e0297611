"""Whether the maps of two sensors agree: what odometry that failed cannot imitate.

The joint solution takes points near a surface as points of it, and leaves out the others, so that residuals of a
wrong pose are small. Here surfaces are those of one sensor alone, and all points of another within their outlines
count. In the wrong place the floor agrees still, and walls do not.
"""

from collections.abc import Sequence

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.surfaces.flat_cells import FlatCells
from calgraph.surfaces.surface_points import THICKNESS_PER_GATE, fit_surfaces

# Distance up to which a point is on a surface, m: that of the last iterations of the joint solution.
_NEAR = 0.09
# Extent of a surface in standard deviations of its points along it: a uniform patch ends at 1.7.
_OUTLINE = 2.0
# Points of a sensor on a surface from which their majority decides.
_MIN_POINTS = 5


def measure_agreement(worlds: Sequence[Sequence[tuple[Array, Index]]]) -> Array:
    """(S, S) by how many surfaces the maps of two sensors agree, along the direction of walls with the fewest.

    Surfaces on which they agree count as 1, others as -1, by the squares of their normals along a direction; the
    worst direction counts, and the worst but one in space, which has a floor.

    Args:
        worlds: of each world, the points (N, n) that each sensor measured there, m, and the views (N,) of these.
    """
    agree, differ = np.sum([compare_maps(world) for world in worlds], axis=0)
    return np.asarray(np.linalg.eigvalsh(agree - differ)[..., -2])


def compare_maps(world: Sequence[tuple[Array, Index]]) -> Array:
    """(2, S, S, n, n) sums of n nᵀ over the surfaces of two sensors on which the other's points are, and are not.

    Args:
        world: the points (N, n) of each sensor, m, and their views (N,).
    """
    S, n = len(world), world[0][0].shape[1]
    sums = np.zeros((2, S, S, n, n))
    for i, (points, views) in enumerate(world):
        surfaces = fit_surfaces(points, views, THICKNESS_PER_GATE * _NEAR)
        for j in range(S):
            if j != i:
                sums[:, i, j] = _compare(surfaces, world[j][0])
    return np.asarray((sums + np.swapaxes(sums, 1, 2)) / 2)


def _compare(surfaces: FlatCells, points: Array) -> Array:
    """(2, n, n) sums of n nᵀ over the surfaces on which points (N, n) are, and are not."""
    index = surfaces.find(points)
    points, index = points[index >= 0], index[index >= 0]
    local = np.einsum("ni,nij->nj", points - surfaces.center[index], surfaces.axes[index])
    inside = np.all(np.abs(local[:, 1:]) < _OUTLINE * surfaces.extent[index], axis=1)
    index, near = index[inside], np.abs(local[inside, 0]) < _NEAR
    count = np.bincount(index, minlength=len(surfaces.keys))
    share = np.bincount(index, near, len(surfaces.keys)) / np.maximum(count, 1)
    on = np.array([share > 0.5, share <= 0.5]) & (count >= _MIN_POINTS)
    return np.asarray(np.einsum("kc,ci,cj->kij", on.astype(np.float64), surfaces.normals, surfaces.normals))

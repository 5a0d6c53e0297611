"""The floor of a simulated building: walls that beams hit and bodies keep away from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from calgraph.errors import InputError
from calgraph.geometry import Array

_CELL = 0.2
"""Edge of the cells in which ways are planned, m."""
_AT_ONCE = 500
"""Points that distances are computed for together."""
_STEPS = np.array([(0, 1), (1, 0), (1, 1), (1, -1)])
"""Half of the eight neighbours of a cell; the other half are their opposites."""


@dataclass(frozen=True, eq=False)
class Floor:
    """Where bodies may be, and what stands in the way of beams."""

    outline: Array
    """(K, 2) corners of the polygon outside of which nobody goes, m."""
    walled: bool
    """Whether the outline is a wall."""
    obstacles: tuple[Array, ...]
    """Polygons (K, 2) that nobody enters, m."""

    @cached_property
    def segments(self) -> Array:
        """(S, 2, 2) all walls and sides of obstacles: both ends, m."""
        polygons = [*([self.outline] if self.walled else []), *self.obstacles]
        return np.concatenate([sides(p) for p in polygons]) if polygons else np.zeros((0, 2, 2))

    def clearance(self, points: Array) -> Array:
        """Distances (N,) of points (N, 2) from anything in the way or the floor's end, m; negative behind it."""
        edges = np.concatenate([sides(self.outline), *(sides(polygon) for polygon in self.obstacles)])
        distance = distance_to_segments(points, edges)
        outside = ~inside(self.outline, points)
        for polygon in self.obstacles:
            outside |= inside(polygon, points)
        return np.where(outside, -distance, distance)


@dataclass(frozen=True, eq=False)
class Ways:
    """The part of a floor that a body can get around in, as connected cells."""

    corner: Array
    """(2,) centre of the cell (0, 0), m."""
    clearance: Array
    """(columns, rows) distance of each cell's centre from anything in the way, m."""
    free: NDArray[np.bool_]
    """(columns, rows) whether a body's centre may be there: one connected region."""
    graph: csr_array
    """Lengths of the ways between neighbouring free cells, by flat index."""

    def cells(self, points: Array) -> NDArray[np.intp]:
        """(..., 2) cells of points (..., 2), those beyond the floor in the outermost ones."""
        cells = np.rint((points - self.corner) / _CELL).astype(np.intp)
        return np.clip(cells, 0, np.array(self.free.shape) - 1)

    def room(self, points: Array) -> Array:
        """Clearance (...) at points (..., 2) to within a cell, on the safe side, m."""
        cells = self.cells(points)
        off = np.linalg.norm(points - (self.corner + _CELL * cells), axis=-1)
        return np.asarray(self.clearance[cells[..., 0], cells[..., 1]] - off)

    def nearest(self, point: Array) -> Array:
        """(2,) the centre of the free cell next to a point (2,)."""
        centers = self.corner + _CELL * np.argwhere(self.free)
        return np.asarray(centers[np.argmin(np.linalg.norm(centers - point, axis=1))])

    def random_place(self, rng: np.random.Generator) -> Array:
        """(2,) the centre of a free cell."""
        return np.asarray(self.corner + _CELL * rng.choice(np.argwhere(self.free)))

    def way(self, start: Array, goal: Array) -> Array:
        """(L, 2) the centres of the cells of a shortest way between two places on the floor."""
        first, last = (
            int(np.ravel_multi_index(self.cells(self.nearest(p)), self.free.shape)) for p in (start, goal)
        )
        # From the goal, so that following the predecessors leads forwards.
        _, predecessors = dijkstra(self.graph, directed=False, indices=last, return_predecessors=True)
        flat = [first]
        while flat[-1] != last:
            flat.append(int(predecessors[flat[-1]]))
        return np.asarray(self.corner + _CELL * np.stack(np.unravel_index(flat, self.free.shape), axis=1))


def ways_through(floor: Floor, kept_clear: float, standing: Array, away: float) -> Ways:
    """The largest connected region of a floor for bodies that keep their distance.

    Args:
        floor: walls and obstacles.
        kept_clear: of a body's centre from walls, at least, m.
        standing: (N, 2) places of scanners, which nobody walks over.
        away: of a body's centre from those, at least, m.

    Raises:
        InputError: there is no such region.

    """
    low, high = floor.outline.min(axis=0), floor.outline.max(axis=0)
    axes = [np.arange(a + _CELL / 2, b, _CELL) for a, b in zip(low, high, strict=True)]
    shape = (len(axes[0]), len(axes[1]))
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    clearance = floor.clearance(centers)
    for scanner in standing:
        # As if a wall were as far in front of the scanner as makes both distances one.
        clearance = np.minimum(clearance, np.linalg.norm(centers - scanner, axis=1) - away + kept_clear)
    clearance = clearance.reshape(shape)
    regions, _ = label(clearance >= kept_clear, structure=np.ones((3, 3)))
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    free = (regions == np.argmax(sizes)) & (clearance >= kept_clear)
    if not free.any():
        raise InputError(
            f"people.clearance: nobody fits who stays {kept_clear:.2f} m away from everything; take less"
        )
    return Ways(centers[0], clearance, free, _neighbourhood(free, clearance, kept_clear))


def sides(polygon: Array) -> Array:
    """(K, 2, 2) the sides of a polygon (K, 2)."""
    return np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)


def inside(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """(N,) which points (N, 2) lie in a polygon (K, 2), by the even-odd rule."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    height = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / height
    return np.asarray((crosses & (x < at)).sum(axis=1) % 2 == 1)


def distance_to_segments(points: Array, segments: Array) -> Array:
    """Distances (N,) of points (N, 2) from the nearest of segments (S, 2, 2)."""
    if len(segments) == 0:
        return np.full(len(points), np.inf)
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    square = np.maximum((along**2).sum(axis=1), 1e-12)
    nearest = [np.zeros(0)]
    # In parts that fit into the processor's cache.
    for first in range(0, len(points), _AT_ONCE):
        x, y = np.moveaxis(points[first : first + _AT_ONCE, None] - start, -1, 0)
        part = np.clip((x * along[:, 0] + y * along[:, 1]) / square, 0, 1)
        off = (x - part * along[:, 0]) ** 2 + (y - part * along[:, 1]) ** 2
        nearest.append(np.sqrt(off.min(axis=1)))
    return np.concatenate(nearest)


def rectangle(center: Sequence[float] | Array, size: Sequence[float] | Array, yaw: float = 0.0) -> Array:
    """(4, 2) the corners of a rectangle, counter-clockwise."""
    c, s = np.cos(yaw), np.sin(yaw)
    corners = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size
    return np.asarray(corners @ np.array([[c, s], [-s, c]]) + center)


def _neighbourhood(free: NDArray[np.bool_], clearance: Array, kept_clear: float) -> csr_array:
    index = np.arange(free.size).reshape(free.shape)
    # Ways along walls cost more, so that people walk through the middle where there is one.
    cost = 1 + 0.8 * np.exp(-(clearance - kept_clear) / 0.4)
    rows, columns, lengths = [], [], []
    for dx, dy in _STEPS:
        here = (slice(None, free.shape[0] - dx), slice(max(-dy, 0), free.shape[1] - max(dy, 0)))
        there = (slice(dx, None), slice(max(dy, 0), free.shape[1] + min(dy, 0)))
        both = free[here] & free[there]
        rows.append(index[here][both])
        columns.append(index[there][both])
        lengths.append(_CELL * np.hypot(dx, dy) * (cost[here] + cost[there])[both] / 2)
    ij = (np.concatenate(rows), np.concatenate(columns))
    return coo_array((np.concatenate(lengths), ij), shape=(free.size, free.size)).tocsr()

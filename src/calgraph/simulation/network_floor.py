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

_TILE = 4.0
"""Edge of the square tiles whose points are looked at together, m: as large as a room with some ten walls."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Axis-aligned boxes on the floor, of which any may be nowhere: NaN."""

    low: Array
    """(N, 2) lower left corners, m."""
    high: Array
    """(N, 2) upper right corners, m."""

    def near(self, low: Array, high: Array) -> NDArray[np.intp]:
        """Numbers, in order, of the boxes that touch the one with corners (2,)."""
        return np.flatnonzero(((self.low <= high) & (self.high >= low)).all(axis=1))


def bound_polygons(polygons: Sequence[Array] | Array) -> Boxes:
    """The bounding boxes of polygons or segments (K, 2) each."""
    low, high = ([reduce(polygon, axis=0) for polygon in polygons] for reduce in (np.min, np.max))
    return Boxes(np.reshape(low, (-1, 2)), np.reshape(high, (-1, 2)))


def group_by_tile(points: Array) -> list[NDArray[np.intp]]:
    """Indices of points (N, 2), those in one tile together."""
    if not len(points):
        return []
    x, y = np.floor(points / _TILE).astype(np.intp).T
    tiles = (x - x.min()) * (1 + np.ptp(y)) + y - y.min()
    order = np.argsort(tiles, kind="stable")
    return np.split(order, 1 + np.flatnonzero(np.diff(tiles[order])))


_CELL = 0.2
"""Edge of the cells in which paths are planned, m."""
_BATCH = 500
"""Points per batch of distances, which then fits into the processor's cache."""
_SEARCH_RADIUS = 4.0
"""First radius in which walls are searched, m; it doubles until the nearest one is certain."""
_STEPS = np.array([(0, 1), (1, 0), (1, 1), (1, -1)])
"""Half of the eight neighbours of a cell; the other half follows by symmetry."""


@dataclass(frozen=True, eq=False)
class Floor:
    """Floor plan: where bodies may be, and what blocks beams."""

    outline: Array
    """(K, 2) corners of the polygon that bodies stay in, m."""
    walled: bool
    """Whether the outline is a wall."""
    obstacles: tuple[Array, ...]
    """Polygons (K, 2) that block bodies and beams, m."""

    @cached_property
    def segments(self) -> Array:
        """(S, 2, 2) end points of all walls and sides of obstacles, m."""
        polygons = [*([self.outline] if self.walled else []), *self.obstacles]
        return np.concatenate([polygon_sides(p) for p in polygons]) if polygons else np.zeros((0, 2, 2))

    @cached_property
    def segment_boxes(self) -> Boxes:
        """Of ``segments``."""
        return bound_polygons(self.segments)

    def reach_from(self, point: Array) -> float:
        """Upper bound of the distance of walls and obstacles from a point (2,), m; 0 without any."""
        corners = self._corners
        return float(np.linalg.norm(np.abs(corners - point).max(axis=0))) if len(corners) else 0.0

    @cached_property
    def _corners(self) -> Array:
        """(2, 2) lower left and upper right corner of all segments, or none, m."""
        ends = self.segments.reshape(-1, 2)
        return np.stack([ends.min(axis=0), ends.max(axis=0)]) if len(ends) else np.zeros((0, 2))

    @cached_property
    def _edges(self) -> Array:
        """(E, 2, 2) sides of the outline and of all obstacles, m."""
        return np.concatenate([polygon_sides(polygon) for polygon in (self.outline, *self.obstacles)])

    @cached_property
    def _edge_boxes(self) -> Boxes:
        return bound_polygons(self._edges)

    @cached_property
    def _obstacle_boxes(self) -> Boxes:
        return bound_polygons(self.obstacles)

    def clearance(self, points: Array) -> Array:
        """Distances (N,) of points (N, 2) from obstacles and the outline, m; negative inside or beyond them."""
        distance = np.empty(len(points))
        outside = ~points_inside(self.outline, points)
        for tile in group_by_tile(points):
            here = points[tile]
            distance[tile] = self._distance_to_edges(here)
            for k in self._obstacle_boxes.near(here.min(axis=0), here.max(axis=0)):
                outside[tile] |= points_inside(self.obstacles[k], here)
        return np.where(outside, -distance, distance)

    def _distance_to_edges(self, points: Array) -> Array:
        """Distances (N,) of points (N, 2) that are near to each other from the nearest edge, m."""
        low, high, radius = points.min(axis=0), points.max(axis=0), _SEARCH_RADIUS
        while True:
            near = self._edge_boxes.near(low - radius, high + radius)
            distance = distance_to_segments(points, self._edges[near])
            # Edges that were left out are farther away than the radius from all points.
            if distance.max() <= radius or len(near) == len(self._edges):
                return distance
            radius *= 2


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The part of a floor that is reachable for a body, as connected cells."""

    corner: Array
    """(2,) centre of the cell (0, 0), m."""
    clearance: Array
    """(columns, rows) distance of each cell's centre from obstacles, m."""
    free: NDArray[np.bool_]
    """(columns, rows) cells that a body's centre may be in: one connected region."""
    min_clearance: float
    """Of those cells, m."""

    def cells(self, points: Array) -> NDArray[np.intp]:
        """(..., 2) cells of points (..., 2); points beyond the floor are clipped to the outermost cells."""
        cells = np.rint((points - self.corner) / _CELL).astype(np.intp)
        return np.clip(cells, 0, np.array(self.free.shape) - 1)

    def clearance_at(self, points: Array) -> Array:
        """Lower bound of the clearance (...) at points (..., 2), accurate to a cell, m."""
        cells = self.cells(points)
        off = np.linalg.norm(points - (self.corner + _CELL * cells), axis=-1)
        return np.asarray(self.clearance[cells[..., 0], cells[..., 1]] - off)

    def nearest_free(self, point: Array) -> Array:
        """(2,) the centre of the free cell nearest to a point (2,)."""
        radius = _SEARCH_RADIUS
        while True:
            low, high = self._window(point - radius, point + radius)
            centers = self.corner + _CELL * (low + np.argwhere(self.free[low[0] : high[0], low[1] : high[1]]))
            distances = np.linalg.norm(centers - point, axis=1)
            # Cells beyond the window are farther away than the radius, less half a cell.
            if distances.min(initial=np.inf) < radius - _CELL or (high - low == self.free.shape).all():
                return np.asarray(centers[np.argmin(distances)])
            radius *= 2

    def random_place(self, rng: np.random.Generator) -> Array:
        """(2,) the centre of a free cell."""
        return np.asarray(self.corner + _CELL * rng.choice(self._free_cells))

    def random_place_near(self, point: Array, distance: float, rng: np.random.Generator) -> Array:
        """(2,) the centre of a free cell at most ``distance``, m, away from a free point (2,) in x and in y."""
        low, high = self._window(point - distance, point + distance)
        cells = low + np.argwhere(self.free[low[0] : high[0], low[1] : high[1]])
        return np.asarray(self.corner + _CELL * rng.choice(cells))

    def plan_path(self, start: Array, goal: Array, detour: float = np.inf) -> Array:
        """(L, 2) the centres of the cells of a shortest path between two points on the floor.

        Args:
            start: (2,) m.
            goal: (2,) m.
            detour: how far beyond both points paths are searched first, m. Where none leads from one to the other,
                it doubles. Without a limit the whole floor is searched, which costs as much as the floor is large.
        """
        first, last = (self.cells(self.nearest_free(point)) for point in (start, goal))
        while True:
            low, high = self._window(np.minimum(start, goal) - detour, np.maximum(start, goal) + detour)
            cells = self._plan_in_window(first, last, low, high)
            if cells is not None:
                return np.asarray(self.corner + _CELL * cells)
            detour *= 2

    def _window(self, low: Array, high: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """(2,) the first cell, and the one past the last, of a box on the floor, which may be infinite."""
        beyond = _CELL * np.array(self.free.shape) + np.abs(self.corner)
        return self.cells(np.clip(low, -beyond, None)), self.cells(np.clip(high, None, self.corner + beyond)) + 1

    def _plan_in_window(
        self, first: NDArray[np.intp], last: NDArray[np.intp], low: NDArray[np.intp], high: NDArray[np.intp]
    ) -> NDArray[np.intp] | None:
        """(L, 2) the cells of a shortest path within a window, or None."""
        whole = bool((high - low == self.free.shape).all())
        free = self.free[low[0] : high[0], low[1] : high[1]]
        clearance = self.clearance[low[0] : high[0], low[1] : high[1]]
        graph = self._graph if whole else _build_graph(free, clearance, self.min_clearance)
        here, target = (int(np.ravel_multi_index(cell - low, free.shape)) for cell in (first, last))
        # Computed from the goal, so that following the predecessors leads forwards.
        _, predecessors = dijkstra(graph, directed=False, indices=target, return_predecessors=True)
        if here != target and predecessors[here] < 0:
            return None
        flat = [here]
        while flat[-1] != target:
            flat.append(int(predecessors[flat[-1]]))
        return np.asarray(low + np.stack(np.unravel_index(flat, free.shape), axis=1))

    @cached_property
    def _free_cells(self) -> NDArray[np.intp]:
        """(F, 2) all free cells."""
        return np.argwhere(self.free)

    @cached_property
    def _graph(self) -> csr_array:
        """Costs of the steps between neighbouring free cells, by flat index."""
        return _build_graph(self.free, self.clearance, self.min_clearance)


def find_free_space(floor: Floor, min_clearance: float, keep_off: Array) -> FreeSpace:
    """Finds the largest connected region of a floor for bodies that keep their distance.

    Args:
        floor: walls and obstacles.
        min_clearance: of a body's centre from walls, m.
        keep_off: (N, 3) circles that a body's centre stays out of, such as those around scanners: x, y, radius, m.

    Raises:
        InputError: there is no such region.
    """
    low, high = floor.outline.min(axis=0), floor.outline.max(axis=0)
    axes = [np.arange(a + _CELL / 2, b, _CELL) for a, b in zip(low, high, strict=True)]
    shape = (len(axes[0]), len(axes[1]))
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    clearance = floor.clearance(centers)
    clearance, grid = clearance.reshape(shape), centers.reshape(*shape, 2)
    most = float(clearance.max())
    for x, y, radius in keep_off:
        # A circle acts as a wall at the distance that makes both minimum distances equal; beyond the reach it
        # makes no difference.
        reach = most + radius
        near = tuple(
            slice(*np.searchsorted(axis, [middle - reach - _CELL, middle + reach + _CELL]))
            for axis, middle in zip(axes, (x, y), strict=True)
        )
        off = np.linalg.norm(grid[near] - (x, y), axis=-1)
        clearance[near] = np.minimum(clearance[near], off - radius + min_clearance)
    regions, _ = label(clearance >= min_clearance, structure=np.ones((3, 3)))
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    free = (regions == np.argmax(sizes)) & (clearance >= min_clearance)
    if not free.any():
        raise InputError(
            f"people.clearance: no free space remains {min_clearance:.2f} m away from all obstacles; take less"
        )
    return FreeSpace(centers[0], clearance, free, min_clearance)


def polygon_sides(polygon: Array) -> Array:
    """(K, 2, 2) end points of the sides of a polygon (K, 2)."""
    return np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)


def points_inside(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a polygon (K, 2), by the even-odd rule."""
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

    for first in range(0, len(points), _BATCH):
        x, y = np.moveaxis(points[first : first + _BATCH, None] - start, -1, 0)
        part = np.clip((x * along[:, 0] + y * along[:, 1]) / square, 0, 1)
        off = (x - part * along[:, 0]) ** 2 + (y - part * along[:, 1]) ** 2
        nearest.append(np.sqrt(off.min(axis=1)))
    return np.concatenate(nearest)


def rectangle(center: Sequence[float] | Array, size: Sequence[float] | Array, yaw: float = 0.0) -> Array:
    """(4, 2) the corners of a rectangle, counter-clockwise."""
    c, s = np.cos(yaw), np.sin(yaw)
    corners = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size
    return np.asarray(corners @ np.array([[c, s], [-s, c]]) + center)


def _build_graph(free: NDArray[np.bool_], clearance: Array, min_clearance: float) -> csr_array:
    index = np.arange(free.size).reshape(free.shape)
    # Steps along walls cost more, so that people walk through the middle of passages.
    cost = 1 + 0.8 * np.exp(-(clearance - min_clearance) / 0.4)
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

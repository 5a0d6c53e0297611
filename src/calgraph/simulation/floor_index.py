"""Finds what is near on a floor without looking at all of it, so that large buildings cost what they measure."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

_CELL = 4.0
"""Edge of the cells in which boxes are listed, m: as large as a room, which has some ten walls."""


class BoxIndex:
    """Axis-aligned boxes by the square cells of the floor that they cover."""

    def __init__(self) -> None:
        """Without any box."""
        self._count = 0
        self._cells: dict[tuple[int, int], list[int]] = {}
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def add(self, low: Array, high: Array) -> None:
        """Adds a box with corners (2,); its number is how many there were before."""
        for cell in _list_cells(low, high):
            self._cells.setdefault(cell, []).append(self._count)
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        self._count += 1

    def skip(self) -> None:
        """Gives the next number to no box."""
        self._count += 1

    def near(self, low: Array, high: Array) -> NDArray[np.intp]:
        """Numbers, in order, of all boxes that touch the one with corners (2,), and of some beyond it."""
        found: set[int] = set()
        # Where there are boxes, so that a search far away, or in a large box, ends.
        low, high = np.maximum(low, self._low), np.minimum(high, self._high)
        for cell in _list_cells(low, high) if (low <= high).all() else ():
            found.update(self._cells.get(cell, ()))
        return np.array(sorted(found), dtype=np.intp)


def index_polygons(polygons: Iterable[Array]) -> BoxIndex:
    """The bounding boxes of polygons or segments (K, 2) each."""
    index = BoxIndex()
    for polygon in polygons:
        index.add(polygon.min(axis=0), polygon.max(axis=0))
    return index


def group_by_tile(points: Array) -> list[NDArray[np.intp]]:
    """Indices of points (N, 2), those in one cell together."""
    if not len(points):
        return []
    x, y = np.floor(points / _CELL).astype(np.intp).T
    tiles = (x - x.min()) * (1 + np.ptp(y)) + y - y.min()
    order = np.argsort(tiles, kind="stable")
    return np.split(order, 1 + np.flatnonzero(np.diff(tiles[order])))


def _list_cells(low: Array, high: Array) -> list[tuple[int, int]]:
    (i, j), (last_i, last_j) = (np.floor(corner / _CELL).astype(int).tolist() for corner in (low, high))
    return [(x, y) for x in range(i, last_i + 1) for y in range(j, last_j + 1)]

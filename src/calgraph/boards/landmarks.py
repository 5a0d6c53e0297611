"""Positions of the marks on a board: the layout and corner order of every pattern.

Board frame: origin at the centre of the board, x right, y up for a reader of the print, z out of the
face towards the reader.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard
from calgraph.geometry import Array

Ids = NDArray[np.intp]

# Unit squares' corners in the order in which they are detected, in the board frame.
_OPENCV_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
# Kalibr prints its tags upside down compared with how OpenCV draws them.
_KALIBR_CORNERS = -_OPENCV_CORNERS


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The marks on one board. A mark is detected as a whole: a tag with 4 corners, or a single corner."""

    ids: Ids
    """(M,) tag ids; for checkerboards and ChArUco the corner's number, row by row from the top left."""
    corners: Array
    """(M, k, 3) corners of each mark in the board frame, m; k = 4 for tags, clockwise from the top left of the
    tag as OpenCV draws it; k = 1 otherwise."""

    def corners_of(self, ids: Ids) -> Array:
        """Corners (N, k, 3) of the marks ``ids`` (N,), in that order; KeyError if one is not on the board."""
        row = {int(mark): i for i, mark in enumerate(self.ids)}
        return self.corners[[row[int(mark)] for mark in ids]]


def compute_landmarks(board: Board) -> Landmarks:
    """The printed corners of a board, empty if nothing is printed on it."""
    match board.pattern:
        case None:
            return _layout_tags(board)
        case Checkerboard() as p:
            return _layout_lattice(p.columns, p.rows, p.square, p.center)
        case Charuco() as p:
            return _layout_lattice(p.columns - 1, p.rows - 1, p.square, p.center)
        case AprilGrid() as p:
            return _layout_aprilgrid(p)


def _layout_tags(board: Board) -> Landmarks:
    centers = np.array([tag.center for tag in board.tags]).reshape(-1, 1, 2)
    sizes = np.array([tag.size for tag in board.tags]).reshape(-1, 1, 1)
    return Landmarks(
        np.array([tag.id for tag in board.tags], dtype=np.intp), _append_zero(centers + sizes * _OPENCV_CORNERS)
    )


def _layout_lattice(columns: int, rows: int, square: float, center: tuple[float, float]) -> Landmarks:
    """Inner corners of a chessboard, row by row from the top left."""
    x = (np.arange(columns) - (columns - 1) / 2) * square + center[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * square + center[1]
    corners = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    return Landmarks(np.arange(columns * rows), _append_zero(corners))


def _layout_aprilgrid(grid: AprilGrid) -> Landmarks:
    """Kalibr numbers tags from the bottom left, along the rows, upwards."""
    pitch = grid.tag_size * (1 + grid.tag_spacing)
    x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * pitch + grid.center[0]
    y = (np.arange(grid.rows) - (grid.rows - 1) / 2) * pitch + grid.center[1]
    centers = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    return Landmarks(
        grid.first_id + np.arange(len(centers)), _append_zero(centers + grid.tag_size * _KALIBR_CORNERS)
    )


def _append_zero(corners: Array) -> Array:
    """Corners (M, k, 2) on the board as points (M, k, 3) with z = 0."""
    return np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=-1)

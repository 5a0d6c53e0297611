"""The print of a board as bitmaps, from which both simulated and printed boards are drawn."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calgraph.config.target import FAMILIES, AprilGrid, Board, Charuco, Checkerboard, marker_bitmap
from calgraph.geometry import Array

Pair = tuple[float, float]


@dataclass(frozen=True, eq=False)
class PrintedBitmap:
    """A bitmap on the board. Its white modules do not cover the black ones of other bitmaps."""

    bitmap: Array
    """(rows, columns) for a reader of the print: 0 for black, 1 for white."""
    center: Pair
    """In the board frame, m."""
    size: Pair
    """Width and height, m."""
    number: int | None = None
    """Id of the tag or marker; None for other bitmaps."""


def printed_bitmaps(board: Board) -> tuple[PrintedBitmap, ...]:
    """All bitmaps printed on a board; parts of them may extend beyond its edge."""
    match board.pattern:
        case None:
            return tuple(
                PrintedBitmap(
                    marker_bitmap(FAMILIES[board.family], tag.id), tag.center, (tag.size, tag.size), tag.id
                )
                for tag in board.tags
            )
        case Checkerboard() as p:
            return (_chessboard(p.columns + 1, p.rows + 1, p.square, p.center),)
        case Charuco() as p:
            return tuple(_charuco(p))
        case AprilGrid() as p:
            return tuple(_aprilgrid(p, FAMILIES[board.family]))


def black_rectangles(board: Board) -> Array:
    """Black rectangles (N, 4) that together are the print: left, bottom, right, top in the board frame, m.

    They do not overlap and lie within the board.
    """
    rectangles = np.concatenate(
        [_bitmap_rectangles(bitmap) for bitmap in printed_bitmaps(board)] or [np.zeros((0, 4))]
    )
    half = np.array([*board.size, *board.size]) / 2
    rectangles = np.clip(rectangles, -half, half)
    return np.asarray(rectangles[(rectangles[:, 0] < rectangles[:, 2]) & (rectangles[:, 1] < rectangles[:, 3])])


def _bitmap_rectangles(printed: PrintedBitmap) -> Array:
    """The black modules of a bitmap as rectangles (N, 4), one for each run of them in a row."""
    is_black = np.pad(printed.bitmap < 0.5, ((0, 0), (1, 1))).astype(int)
    row, start = np.nonzero(np.diff(is_black, axis=1) == 1)
    _, end = np.nonzero(np.diff(is_black, axis=1) == -1)
    rows, columns = printed.bitmap.shape
    width, height = printed.size[0] / columns, printed.size[1] / rows
    left, top = printed.center[0] - printed.size[0] / 2, printed.center[1] + printed.size[1] / 2
    return np.column_stack(
        [left + width * start, top - height * (row + 1), left + width * end, top - height * row]
    )


def _chessboard(columns: int, rows: int, square: float, center: Pair) -> PrintedBitmap:
    """A chessboard with a black square at the top left."""
    chessboard = np.indices((rows, columns)).sum(axis=0) % 2
    return PrintedBitmap(chessboard.astype(np.float64), center, (square * columns, square * rows))


def _charuco(pattern: Charuco) -> Iterator[PrintedBitmap]:
    """OpenCV's layout: black top-left square, markers numbered row by row through the white squares."""
    squares = _chessboard(pattern.columns, pattern.rows, pattern.square, pattern.center)
    yield squares
    x0, y0 = pattern.center
    for i, (row, column) in enumerate(np.argwhere(squares.bitmap == 1)):
        center = (
            x0 + (column + 0.5 - pattern.columns / 2) * pattern.square,
            y0 + (pattern.rows / 2 - row - 0.5) * pattern.square,
        )
        number = pattern.first_id + i
        bitmap = marker_bitmap(pattern.dictionary, number)
        yield PrintedBitmap(bitmap, center, (pattern.marker, pattern.marker), number)


def _aprilgrid(pattern: AprilGrid, family: str) -> Iterator[PrintedBitmap]:
    """Kalibr's layout: tags upside down, numbered from the bottom left along rows, squares at their corners."""
    gap = pattern.tag_size * pattern.tag_spacing
    pitch = pattern.tag_size + gap
    x0 = pattern.center[0] - pitch * (pattern.columns - 1) / 2
    y0 = pattern.center[1] - pitch * (pattern.rows - 1) / 2
    for i in range(pattern.columns * pattern.rows):
        row, column = divmod(i, pattern.columns)
        upright = marker_bitmap(family, pattern.first_id + i, border=2)
        center = (x0 + column * pitch, y0 + row * pitch)
        yield PrintedBitmap(
            upright[::-1, ::-1], center, (pattern.tag_size, pattern.tag_size), pattern.first_id + i
        )
    for row, column in np.ndindex(pattern.rows + 1, pattern.columns + 1):
        center = (x0 + (column - 0.5) * pitch, y0 + (row - 0.5) * pitch)
        yield PrintedBitmap(np.zeros((1, 1)), center, (gap, gap))

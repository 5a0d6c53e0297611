"""Which part of a board goes on which page, and where on it.

On the board, lengths count from the lower left corner of its sheet, in mm; x is right and y up, on pages too.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from string import ascii_uppercase

import numpy as np

from calgraph.config import Board, black_rectangles
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.printing.paper import MARGIN, Paper

MM = 1000.0
"""In a metre."""
_MOST_PAGES = 400
# Rounding of sizes given in mm or inches must not cost a page, mm.
_TINY = 1e-6


@dataclass(frozen=True)
class Window:
    """A rectangle, mm."""

    left: float
    bottom: float
    right: float
    top: float

    @property
    def width(self) -> float:
        """Mm."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Mm."""
        return self.top - self.bottom

    def within(self, other: "Window") -> "Window":
        """What lies in both."""
        return Window(
            max(self.left, other.left),
            max(self.bottom, other.bottom),
            min(self.right, other.right),
            min(self.top, other.top),
        )


@dataclass(frozen=True)
class Page:
    """One page of a board."""

    paper: Paper
    row: int
    """Counted from the top."""
    column: int
    """Counted from the left."""
    origin: tuple[float, float]
    """Where on the page the lower left corner of the board's sheet is, or would be."""
    window: Window
    """The part of the board that is on the page."""
    joints: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    """Where the next page's edge comes to lie when it is glued over this one: x of those to the right, y of those
    below, on the board."""

    joined: bool = False
    """Whether it is one of several pages that are to be joined."""

    @property
    def label(self) -> str:
        """A letter for the row and a number for the column: B3."""
        letters = ascii_uppercase[self.row % 26] * (1 + self.row // 26)
        return f"{letters}{self.column + 1}"

    def place(self, x: float, y: float) -> tuple[float, float]:
        """A place on the board as one on the page."""
        return x + self.origin[0], y + self.origin[1]


def sheet_ink(board: Board) -> Array:
    """The print as black rectangles (N, 4): left, bottom, right, top on the sheet, mm."""
    return MM * (black_rectangles(board) + 0.5 * np.array([*board.size, *board.size]))


def lay_out(board: Board, paper: Paper | None = None, overlap: float = 10.0) -> tuple[Page, ...]:
    """The pages of a board, in rows from the top.

    A board that the paper has room for is put on one page, upright or turned; else it is tiled over as few pages
    as possible. Its white rim may reach into the margins, or be as large as the paper.

    Args:
        board: to be printed.
        paper: in either orientation; as large as the board with its margins if None.
        overlap: how much neighbouring pages have in common, mm.

    Raises:
        InputError: the overlap leaves nothing new on a page, or it would take hundreds of pages.

    """
    width, height = (MM * length for length in board.size)
    if paper is None:
        paper = Paper(width + 2 * MARGIN, height + 2 * MARGIN)
    if single := [page for turned in (paper, paper.turned) if (page := _single(board, turned))]:
        return (max(single, key=lambda page: page.window.width * page.window.height),)
    if not 0 <= overlap < min(paper.inner) / 2:
        raise InputError(
            f"`overlap`: must be from 0 to {min(paper.inner) / 2:g} mm on this paper, got {overlap:g}"
        )
    pages = min((list(_tiles(width, height, p, overlap)) for p in (paper, paper.turned)), key=len)
    if len(pages) > _MOST_PAGES:
        raise InputError(f"`paper`: it would take {len(pages)} pages; choose larger paper, or a smaller board")
    return tuple(pages)


def _single(board: Board, paper: Paper) -> Page | None:
    """The board in the middle of one page, if there is room for its print within the margins."""
    width, height = (MM * length for length in board.size)
    origin = (paper.width - width) / 2, (paper.height - height) / 2
    if min(origin) < -_TINY:
        return None
    inner = Window(
        MARGIN - origin[0], MARGIN - origin[1], paper.width - MARGIN - origin[0], paper.height - MARGIN - origin[1]
    )
    black = sheet_ink(board)
    if len(black):
        low, high = black[:, :2].min(axis=0) + _TINY, black[:, 2:].max(axis=0) - _TINY
        if (low < [inner.left, inner.bottom]).any() or (high > [inner.right, inner.top]).any():
            return None
    return Page(paper, 0, 0, origin, inner.within(Window(0, 0, width, height)))


def _tiles(width: float, height: float, paper: Paper, overlap: float) -> Iterator[Page]:
    """Pages that cover a sheet, what is left over shared between its edges."""
    inner_width, inner_height = paper.inner
    lefts = _starts(width, inner_width, overlap)
    tops = [height - start for start in _starts(height, inner_height, overlap)]
    sheet = Window(0, 0, width, height)
    for (row, top), (column, left) in product(enumerate(tops), enumerate(lefts)):
        window = Window(left, top - inner_height, left + inner_width, top).within(sheet)
        joints = tuple(lefts[column + 1 : column + 2]), tuple(tops[row + 1 : row + 2])
        origin = MARGIN - left, MARGIN + inner_height - top
        yield Page(paper, row, column, origin, window, joints, len(lefts) * len(tops) > 1)


def _starts(length: float, inner: float, overlap: float) -> list[float]:
    """Where pages begin along an edge of the sheet."""
    step = inner - overlap
    count = max(1, int(np.ceil((length - overlap - _TINY) / step)))
    blank = inner + (count - 1) * step - length
    return [i * step - blank / 2 for i in range(count)]

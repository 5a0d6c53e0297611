"""Papers, and the layout of a board on pages.

Board coordinates are from its lower left corner, in mm; x is right and y up, on pages too.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from string import ascii_uppercase

import numpy as np

from calgraph.config import Board, black_rectangles
from calgraph.errors import InputError
from calgraph.geometry import Array

MARGIN = 15.0
"""Margin around the board, mm: space for rulers and marks, and more than any printer leaves blank."""

COMMON_PAPERS = ("A4", "A3", "A2", "A1", "A0")
"""Papers that a board is put on unless another is asked for, the smallest first."""
_MAX_EDGE = 5000.0
"""A PDF's page has at most 14400 points, 5080 mm, along an edge."""
_PAPER_SIZES = {
    **{f"a{n}": (float(width), float(height)) for n, (width, height) in enumerate(
        [(841, 1189), (594, 841), (420, 594), (297, 420), (210, 297), (148, 210)]
    )},
    "letter": (215.9, 279.4), "legal": (215.9, 355.6), "tabloid": (279.4, 431.8),
    "ansi-c": (431.8, 558.8), "ansi-d": (558.8, 863.6), "ansi-e": (863.6, 1117.6),
}  # fmt: skip
MM_PER_METER = 1000.0
"""Millimetres per metre."""
_MAX_PAGES = 400
"""More pages than this are a mistyped size."""
# Tolerance of sizes given in mm or inches, mm: rounding must not add a page.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Paper:
    """One sheet of paper in its orientation in the printer."""

    width: float
    """mm."""
    height: float
    """mm."""

    @property
    def rotated(self) -> "Paper":
        """The same paper in the other orientation."""
        return Paper(self.height, self.width)

    @property
    def printable_size(self) -> tuple[float, float]:
        """Width and height within the margins, mm."""
        return self.width - 2 * MARGIN, self.height - 2 * MARGIN


def parse_paper(text: str) -> Paper:
    """Parses paper given by name (``A4``, ``letter``) or as ``WIDTHxHEIGHT`` in mm.

    Raises:
        InputError: unknown paper, or one that is too small or too large for a page.
    """
    name = text.strip().lower()
    if name in _PAPER_SIZES:
        return Paper(*_PAPER_SIZES[name])
    width, height = parse_size(text, f"`paper`: is none of {', '.join(_PAPER_SIZES)}, nor")
    if min(width, height) < 4 * MARGIN or max(width, height) > _MAX_EDGE:
        raise InputError(f"`paper`: edges must be from {4 * MARGIN:g} to {_MAX_EDGE:g} mm, got {text!r}")
    return Paper(width, height)


def parse_size(text: str, message: str) -> tuple[float, float]:
    """Parses ``WIDTHxHEIGHT`` in mm.

    Args:
        text: such as ``1200x900``.
        message: beginning of the error message.

    Raises:
        InputError: the text has another form.
    """
    if re.fullmatch(r"\s*[\d.]+\s*[x×]\s*[\d.]+\s*m\s*|\s*\d\.\d*\s*[x×]\s*\d\.\d*\s*", text, re.IGNORECASE):
        raise InputError(f"{message} WIDTHxHEIGHT in mm, such as 1200x900; got {text!r}, which seems to be in m")
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*[x×]\s*(\d+(?:\.\d*)?)\s*(?:mm)?\s*", text, re.IGNORECASE)
    if not match or not all(float(length) > 0 for length in match.groups()):
        raise InputError(f"{message} WIDTHxHEIGHT in mm, such as 1200x900; got {text!r}")
    return float(match[1]), float(match[2])


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

    def intersect(self, other: "Window") -> "Window":
        """The intersection with another window."""
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
    """Position of the board's lower left corner on the page, which may lie outside of it."""
    window: Window
    """The part of the board on the page."""
    overlap_edges: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    """Edges of the next pages when they are glued over this one, on the board: x of those to the right, y of those
    below."""

    is_tile: bool = False
    """Whether it is one of several pages that are joined."""

    @property
    def label(self) -> str:
        """A letter for the row and a number for the column: B3."""
        letters = ascii_uppercase[self.row % 26] * (1 + self.row // 26)
        return f"{letters}{self.column + 1}"

    def to_page(self, x: float, y: float) -> tuple[float, float]:
        """Page coordinates of a point on the board."""
        return x + self.origin[0], y + self.origin[1]


def black_extent_mm(board: Board) -> Array:
    """What the black of the print covers: left, bottom, right, top on the board, mm; (0, 4) of an empty one."""
    if board.inverted:
        return MM_PER_METER * np.array([[0.0, 0.0, *board.size]])
    black = black_rectangles_mm(board)
    return np.concatenate([black[:, :2].min(axis=0), black[:, 2:].max(axis=0)])[None] if len(black) else black


def black_rectangles_mm(board: Board) -> Array:
    """The print as black rectangles (N, 4), white ones if inverted: left, bottom, right, top on the board, mm."""
    return MM_PER_METER * (black_rectangles(board) + 0.5 * np.array([*board.size, *board.size]))


def layout_pages(board: Board, paper: Paper | None = None, overlap: float = 10.0) -> tuple[Page, ...]:
    """Arranges a board on pages, in rows from the top.

    A board that fits the paper is put on one page, in either orientation; otherwise it is tiled over the fewest
    pages. Its white rim may extend into the margins, or be as large as the paper.

    Args:
        board: to be printed.
        paper: in either orientation; as large as the board with its margins if None.
        overlap: of neighbouring pages, mm.

    Raises:
        InputError: the overlap is larger than a page, or more than 400 pages are needed.
    """
    width, height = (MM_PER_METER * length for length in board.size)
    if paper is None:
        paper = Paper(width + 2 * MARGIN, height + 2 * MARGIN)
    if single := [page for turned in (paper, paper.rotated) if (page := _single(board, turned))]:
        return (max(single, key=lambda page: page.window.width * page.window.height),)
    if not 0 <= overlap < min(paper.printable_size) / 2:
        raise InputError(
            f"`overlap`: must be from 0 to {min(paper.printable_size) / 2:g} mm on this paper, got {overlap:g}"
        )
    pages = min((list(_tile_pages(width, height, p, overlap)) for p in (paper, paper.rotated)), key=len)
    if len(pages) > _MAX_PAGES:
        raise InputError(f"`paper`: it would take {len(pages)} pages; choose larger paper, or a smaller board")
    return tuple(pages)


def choose_paper(board: Board) -> Paper | None:
    """The smallest common paper that takes a board on one page; None if none does."""
    papers = (parse_paper(name) for name in COMMON_PAPERS)
    return next((paper for paper in papers if any(_single(board, p) for p in (paper, paper.rotated))), None)


def _single(board: Board, paper: Paper) -> Page | None:
    """The board in the middle of one page, if there is room for its print within the margins."""
    width, height = (MM_PER_METER * length for length in board.size)
    origin = (paper.width - width) / 2, (paper.height - height) / 2
    if min(origin) < -_ROUNDING:
        return None
    inner = Window(
        MARGIN - origin[0], MARGIN - origin[1], paper.width - MARGIN - origin[0], paper.height - MARGIN - origin[1]
    )
    for left, bottom, right, top in black_extent_mm(board).tolist():
        if min(left - inner.left, bottom - inner.bottom, inner.right - right, inner.top - top) < -_ROUNDING:
            return None
    return Page(paper, 0, 0, origin, inner.intersect(Window(0, 0, width, height)))


def _tile_pages(width: float, height: float, paper: Paper, overlap: float) -> Iterator[Page]:
    """Pages that cover a board; the remaining space is distributed evenly to its edges."""
    inner_width, inner_height = paper.printable_size
    lefts = _tile_starts(width, inner_width, overlap)
    tops = [height - start for start in _tile_starts(height, inner_height, overlap)]
    whole = Window(0, 0, width, height)
    for (row, top), (column, left) in product(enumerate(tops), enumerate(lefts)):
        window = Window(left, top - inner_height, left + inner_width, top).intersect(whole)
        joints = tuple(lefts[column + 1 : column + 2]), tuple(tops[row + 1 : row + 2])
        origin = MARGIN - left, MARGIN + inner_height - top
        yield Page(paper, row, column, origin, window, joints, len(lefts) * len(tops) > 1)


def _tile_starts(length: float, inner: float, overlap: float) -> list[float]:
    """Starts of the pages along an edge of the board."""
    step = inner - overlap
    count = max(1, int(np.ceil((length - overlap - _ROUNDING) / step)))
    blank = inner + (count - 1) * step - length
    return [i * step - blank / 2 for i in range(count)]

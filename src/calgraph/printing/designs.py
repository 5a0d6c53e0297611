"""Design of boards: the largest print that fits, or the given sizes."""

from collections.abc import Mapping
from math import floor
from pathlib import Path
from typing import Any, Literal

from calgraph.config import Board, Tag
from calgraph.config.target import AtLeastOne, Index, Length, Pair
from calgraph.errors import InputError
from calgraph.io.strict_model import StrictModel
from calgraph.io.yaml_reading import validate_content
from calgraph.printing.pages import MARGIN

BoardKind = Literal["tags", "aprilgrid", "charuco", "checkerboard"]

DEFAULT_SIZE = (1200.0, 900.0)
"""Width and height of the usual board, mm: that of the simulator and of the README."""
_MIN_RIM = MARGIN + 5.0
"""Minimum white rim around the print, mm: on a board as large as the paper it holds the rulers."""
_TAG_EDGE = (0.32 / 1.2, 0.32 / 0.9)
"""Largest edge of a tag over width and height of the board: 0.32 m on the board of 1.2 by 0.9 m of the simulator
and of the README, which leaves a rim of more than one of the tag's ten modules."""
_TAG_CENTER = (0.38 / 1.2, 0.2 / 0.9)
"""Distance of the tags' centres from the middle of that board over its width and height."""
_DEFAULT_SHAPES = {"aprilgrid": (6, 4), "charuco": (8, 6), "checkerboard": (8, 5)}
"""Columns and rows of a board in landscape: tags, squares, and inner corners. Of a checkerboard's numbers one is
odd and one even: only then its orientation is unambiguous."""
# Kinds of boards that each option applies to.
_OPTION_KINDS: Mapping[str, tuple[BoardKind, ...]] = {
    "columns": ("aprilgrid", "charuco", "checkerboard"),
    "rows": ("aprilgrid", "charuco", "checkerboard"),
    "square": ("charuco", "checkerboard"),
    "tag_size": ("tags", "aprilgrid"),
    "spacing": ("aprilgrid",),
    "marker": ("charuco",),
    "dictionary": ("charuco",),
    "family": ("tags", "aprilgrid"),
    "first_id": ("tags", "aprilgrid", "charuco"),
    "tags": ("tags",),
}


class BoardOptions(StrictModel):
    """Options of a print; those left out are chosen so that the print fills the board."""

    kind: BoardKind = "tags"
    """AprilTags, or a pattern."""
    columns: AtLeastOne | None = None
    """Of tags (aprilgrid), squares (charuco), or inner corners (checkerboard)."""
    rows: AtLeastOne | None = None
    """As columns."""
    square: Length | None = None
    """Edge of a square, mm."""
    tag_size: Length | None = None
    """Edge of a tag's black square, mm."""
    spacing: Length | None = None
    """Gap between an AprilGrid's tags as a fraction of their size; 0.3 if left out."""
    marker: Length | None = None
    """Edge of a ChArUco board's markers, mm; 3/4 of a square if left out."""
    dictionary: str | None = None
    """Of a ChArUco board's markers, OpenCV's name; DICT_5X5_100 if left out."""
    family: str | None = None
    """Of AprilTags; tag36h11 if left out."""
    first_id: Index | None = None
    """Number of the first tag or marker, by which boards are distinguished; 0 if left out."""
    tags: tuple[Tag, ...] | None = None
    """Tags at given positions, as in rig.yaml, m; three that fill the board if left out."""
    inverted: bool = False
    """Exchange black and white."""


def design_board(size: Pair, options: BoardOptions) -> Board:
    """Designs a board of the given width and height, mm.

    Raises:
        InputError: an option does not apply to this kind of board, or the print does not fit.
    """
    for name, kinds in _OPTION_KINDS.items():
        if getattr(options, name) is not None and options.kind not in kinds:
            raise InputError(f"`{name}`: applies to {' and '.join(kinds)} only, not to a board of {options.kind}")
    space = size[0] - 2 * _MIN_RIM, size[1] - 2 * _MIN_RIM
    if min(space) < _MIN_RIM:
        raise InputError(
            f"`size`: leaves no space for a print within a rim of {_MIN_RIM:g} mm, got {size[0]:g}x{size[1]:g}"
        )
    content = {
        "size": [_m(length) for length in size],
        **_DESIGNERS[options.kind](space, options),
        "inverted": options.inverted,
    }
    return validate_content(Board, content, Path("the requested board"))


def _design_tags(space: Pair, options: BoardOptions) -> dict[str, Any]:
    """MSG-Cal's board: three tags, two along one edge and one before the middle of the other."""
    family = options.family or "tag36h11"
    if options.tags is not None:
        return {"family": family, "tags": [tag.model_dump() for tag in options.tags]}
    long, short = max(space), min(space)
    if options.tag_size:
        edge = options.tag_size
        along, across = (long - edge) / 2, (short - edge) / 2
    else:
        width, height = long + 2 * _MIN_RIM, short + 2 * _MIN_RIM
        edge = _round_down(min(_TAG_EDGE[0] * width, _TAG_EDGE[1] * height, (short - _MIN_RIM) / 2))
        along = min(_TAG_CENTER[0] * width, (long - edge) / 2)
        across = min(_TAG_CENTER[1] * height, (short - edge) / 2)
    places = [(-along, across), (along, across), (0.0, -across)]
    if space[1] > space[0]:
        places = [(0.0 - y, 0.0 - x) for x, y in places]
    first = options.first_id or 0
    tags = [
        {"id": first + i, "size": _m(edge), "center": [_m(round(x, 1)), _m(round(y, 1))]}
        for i, (x, y) in enumerate(places)
    ]
    return {"family": family, "tags": tags}


def _design_aprilgrid(space: Pair, options: BoardOptions) -> dict[str, Any]:
    spacing = 0.3 if options.spacing is None else options.spacing
    # Small squares are at all corners of all tags: n tags take n + (n + 1) spacing.
    columns, rows, edge = _fit_grid(space, options, options.tag_size, 1 + spacing, spacing)
    pattern = {
        "columns": columns,
        "rows": rows,
        "tag_size": _m(edge),
        "tag_spacing": spacing,
        "first_id": options.first_id or 0,
    }
    return {"family": options.family or "tag36h11", "pattern": {"kind": "aprilgrid", **pattern}}


def _design_charuco(space: Pair, options: BoardOptions) -> dict[str, Any]:
    columns, rows, square = _fit_grid(space, options, options.square, 1, 0)
    pattern = {
        "columns": columns,
        "rows": rows,
        "square": _m(square),
        "marker": _m(options.marker or _round_down(0.75 * square)),
        "dictionary": options.dictionary or "DICT_5X5_100",
        "first_id": options.first_id or 0,
    }
    return {"pattern": {"kind": "charuco", **pattern}}


def _design_checkerboard(space: Pair, options: BoardOptions) -> dict[str, Any]:
    columns, rows, square = _fit_grid(space, options, options.square, 1, 1)
    return {"pattern": {"kind": "checkerboard", "columns": columns, "rows": rows, "square": _m(square)}}


_DESIGNERS = {
    "tags": _design_tags,
    "aprilgrid": _design_aprilgrid,
    "charuco": _design_charuco,
    "checkerboard": _design_checkerboard,
}


def _fit_grid(
    space: Pair, options: BoardOptions, edge: float | None, each: float, more: float
) -> tuple[int, int, float]:
    """Columns, rows and edge of a grid of which n elements are ``(each n + more)`` edges long."""
    usual = _DEFAULT_SHAPES[options.kind] if space[0] >= space[1] else _DEFAULT_SHAPES[options.kind][::-1]
    if edge is None:
        columns, rows = options.columns or usual[0], options.rows or usual[1]
        edge = _round_down(min(space[0] / (each * columns + more), space[1] / (each * rows + more)))
        return columns, rows, edge
    most = [max(1, floor((length / edge - more) / each + 1e-9)) for length in space]
    columns, rows = options.columns or most[0], options.rows or most[1]
    if options.kind == "checkerboard" and options.rows is None and (columns + rows) % 2 == 0:
        rows -= 1
    return columns, rows, edge


def _round_down(length: float) -> float:
    """Rounds down to whole mm, which a ruler can verify; lengths below 20 mm to tenths."""
    return float(floor(length)) if length >= 20 else floor(10 * length) / 10


def _m(length: float) -> float:
    """From mm to m, without the binary fractions of the division."""
    return round(length / 1000, 7)

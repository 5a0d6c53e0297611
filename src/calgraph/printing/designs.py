"""Boards that make good use of a sheet: as large a print as fits, or the sizes that were asked for."""

from collections.abc import Mapping
from math import floor
from pathlib import Path
from typing import Any, Literal

from calgraph.config import Board, Tag
from calgraph.config.strict_model import StrictModel
from calgraph.config.target import AtLeastOne, Index, Length, Pair
from calgraph.errors import InputError
from calgraph.io.yaml_reading import validate_content
from calgraph.printing.paper import MARGIN

BoardKind = Literal["tags", "aprilgrid", "charuco", "checkerboard"]

_RIM = MARGIN + 5.0
"""White around the print, mm: a sheet as large as the paper has its rulers there, and some distance to them."""
_SHAPES: Mapping[BoardKind, tuple[int, int]] = {"aprilgrid": (6, 4), "charuco": (8, 6), "checkerboard": (8, 5)}
"""Columns and rows of a sheet that lies: tags, squares, and inner corners. Of a checkerboard's numbers one is odd
and one even, as only then does it look different upside down."""
_MEANT_FOR: Mapping[str, tuple[BoardKind, ...]] = {
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


class Wishes(StrictModel):
    """What is asked of a print; what is left out is chosen so that the print fills the sheet."""

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
    """Number of the first tag or marker, by which boards are told apart; 0 if left out."""
    tags: tuple[Tag, ...] | None = None
    """Tags at chosen places, as in rig.yaml, m; three that fill the sheet if left out."""


def design(size: Pair, wishes: Wishes) -> Board:
    """A board on a sheet of the given width and height, mm.

    Raises:
        InputError: a wish is not for this kind of board, or they do not fit the sheet.

    """
    for name, kinds in _MEANT_FOR.items():
        if getattr(wishes, name) is not None and wishes.kind not in kinds:
            raise InputError(f"`{name}`: is for {' and '.join(kinds)}, which a board of {wishes.kind} is not")
    room = size[0] - 2 * _RIM, size[1] - 2 * _RIM
    if min(room) < _RIM:
        raise InputError(
            f"`size`: leaves no room for a print within a rim of {_RIM:g} mm, got {size[0]:g}x{size[1]:g}"
        )
    content = {"size": [_m(length) for length in size], **_DESIGNS[wishes.kind](room, wishes)}
    return validate_content(Board, content, Path("the board asked for"))


def _tags(room: Pair, wishes: Wishes) -> dict[str, Any]:
    """MSG-Cal's board: three tags, two along one edge and one before the middle of the other."""
    family = wishes.family or "tag36h11"
    if wishes.tags is not None:
        return {"family": family, "tags": [tag.model_dump() for tag in wishes.tags]}
    long, short = max(room), min(room)
    edge = wishes.tag_size or _round(min(0.3 * long, 0.445 * short))
    along, across = (long - edge) / 2, (short - edge) / 2
    places = [(-along, across), (along, across), (0.0, -across)]
    if room[1] > room[0]:
        places = [(-y, -x) for x, y in places]
    first = wishes.first_id or 0
    tags = [{"id": first + i, "size": _m(edge), "center": [_m(x), _m(y)]} for i, (x, y) in enumerate(places)]
    return {"family": family, "tags": tags}


def _aprilgrid(room: Pair, wishes: Wishes) -> dict[str, Any]:
    spacing = 0.3 if wishes.spacing is None else wishes.spacing
    # Squares stand at all corners of all tags: n tags take n + (n + 1) spacing.
    columns, rows, edge = _fitted(room, wishes, wishes.tag_size, 1 + spacing, spacing)
    pattern = {
        "columns": columns,
        "rows": rows,
        "tag_size": _m(edge),
        "tag_spacing": spacing,
        "first_id": wishes.first_id or 0,
    }
    return {"family": wishes.family or "tag36h11", "pattern": {"kind": "aprilgrid", **pattern}}


def _charuco(room: Pair, wishes: Wishes) -> dict[str, Any]:
    columns, rows, square = _fitted(room, wishes, wishes.square, 1, 0)
    pattern = {
        "columns": columns,
        "rows": rows,
        "square": _m(square),
        "marker": _m(wishes.marker or _round(0.75 * square)),
        "dictionary": wishes.dictionary or "DICT_5X5_100",
        "first_id": wishes.first_id or 0,
    }
    return {"pattern": {"kind": "charuco", **pattern}}


def _checkerboard(room: Pair, wishes: Wishes) -> dict[str, Any]:
    columns, rows, square = _fitted(room, wishes, wishes.square, 1, 1)
    return {"pattern": {"kind": "checkerboard", "columns": columns, "rows": rows, "square": _m(square)}}


_DESIGNS = {"tags": _tags, "aprilgrid": _aprilgrid, "charuco": _charuco, "checkerboard": _checkerboard}


def _fitted(room: Pair, wishes: Wishes, edge: float | None, each: float, more: float) -> tuple[int, int, float]:
    """Columns, rows and edge of a lattice of which n elements are ``(each n + more)`` edges long."""
    usual = _SHAPES[wishes.kind] if room[0] >= room[1] else _SHAPES[wishes.kind][::-1]
    if edge is None:
        columns, rows = wishes.columns or usual[0], wishes.rows or usual[1]
        return columns, rows, _round(min(room[0] / (each * columns + more), room[1] / (each * rows + more)))
    most = [max(1, floor((length / edge - more) / each + 1e-9)) for length in room]
    columns, rows = wishes.columns or most[0], wishes.rows or most[1]
    if wishes.kind == "checkerboard" and wishes.rows is None and (columns + rows) % 2 == 0:
        rows -= 1
    return columns, rows, edge


def _round(length: float) -> float:
    """Down to whole mm, which one can check with a ruler; small ones to tenths."""
    return float(floor(length)) if length >= 20 else floor(10 * length) / 10


def _m(length: float) -> float:
    """From mm to m, without the binary fractions of the division."""
    return round(length / 1000, 7)

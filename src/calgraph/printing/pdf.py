"""The PDF of boards: black rectangles at true scale, with rulers, marks to cut and to join by, and captions."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard
from calgraph.io import write_atomically
from calgraph.printing.pages import MM, Page, sheet_ink

_HAIRLINE = 0.1
"""Width of all lines, mm."""
_TINY = 1e-6
"""Rounding, mm."""
_FONT, _SMALL, _LARGE = "Helvetica", 2.1, 2.6
"""Sizes of letters in mm."""
_TICKS = {10: 4.0, 5: 3.0, 1: 1.8}
"""Lengths of a ruler's ticks at multiples of so many mm."""
_CAPTION, _LABEL = 5.2, 7.2
"""Baselines of the caption and of the page's label, mm from the lower and the upper edge of the page."""
_ARROW = 3.5
"""Length of the arrowheads that show where to join pages, mm."""


def write_pdf(path: Path, boards: Sequence[tuple[Board, Sequence[Page]]]) -> None:
    """Writes the pages of boards, one board after the other; the same boards give the same file.

    Raises:
        InputError: ``path`` cannot be written.

    """
    with write_atomically(path) as temporary:
        canvas = Canvas(str(temporary), invariant=1, pageCompression=1)
        canvas.setTitle("calgraph board")
        canvas.setCreator("calgraph")
        # Viewers would offer to fit the page to the paper otherwise.
        canvas.setViewerPreference("PrintScaling", "None")
        for board, pages in boards:
            for page in pages:
                _draw(canvas, board, page, len(pages))
                canvas.showPage()
        canvas.save()


def caption(board: Board) -> str:
    """The board's numbers in one line."""
    width, height = (_mm(length) for length in board.size)
    return f"{_print_in_words(board)}; sheet {width} x {height} mm"


def _print_in_words(board: Board) -> str:
    match board.pattern:
        case None if not board.tags:
            return "nothing printed"
        case None:
            sizes = sorted({tag.size for tag in board.tags})
            ids = ", ".join(str(tag.id) for tag in board.tags)
            return f"{board.family}, ids {ids}, tags of {' and '.join(_mm(size) for size in sizes)} mm"
        case Checkerboard() as p:
            return f"checkerboard, {p.columns} x {p.rows} inner corners, squares of {_mm(p.square)} mm"
        case Charuco() as p:
            lengths = f"squares of {_mm(p.square)} mm, markers of {_mm(p.marker)} mm from {p.first_id}"
            return f"ChArUco, {p.dictionary}, {p.columns} x {p.rows} squares, {lengths}"
        case AprilGrid() as p:
            lengths = f"tags of {_mm(p.tag_size)} mm from {p.first_id}, spacing {p.tag_spacing:g}"
            return f"AprilGrid, {board.family}, {p.columns} x {p.rows}, {lengths}"


def _mm(length: float) -> str:
    return f"{MM * length:.5g}"


def _draw(canvas: Canvas, board: Board, page: Page, count: int) -> None:
    canvas.setPageSize((page.paper.width * mm, page.paper.height * mm))
    canvas.scale(mm, mm)
    canvas.setLineWidth(_HAIRLINE)
    _draw_ink(canvas, board, page)
    _draw_cuts(canvas, board, page)
    _draw_rulers(canvas, page, (page.window.left, page.window.bottom) if count == 1 else (0.0, 0.0))
    _draw_joints(canvas, page)
    _draw_words(canvas, board, page, count)


def _draw_ink(canvas: Canvas, board: Board, page: Page) -> None:
    """The print as one path: rectangles filled one by one show seams where they touch."""
    window, black = page.window, sheet_ink(board)
    low = np.maximum(black[:, :2], [window.left, window.bottom])
    high = np.minimum(black[:, 2:], [window.right, window.top])
    seen = (low < high).all(axis=1)
    path = canvas.beginPath()
    for (left, bottom), (width, height) in zip((low + page.origin)[seen], (high - low)[seen], strict=True):
        path.rect(float(left), float(bottom), float(width), float(height))
    canvas.drawPath(path, stroke=0, fill=1)


def _draw_cuts(canvas: Canvas, board: Board, page: Page) -> None:
    """Lines to cut along, outside of the print. There are none where the sheet is as large as the paper."""
    (left, bottom), (right, top) = _corners(page)
    width, height = (MM * length for length in board.size)
    if page.paper.width - width > _TINY or page.joined:
        for x in (left, right):
            canvas.line(x, bottom - 1, x, bottom - 7)
            canvas.line(x, top + 1, x, top + 7)
    if page.paper.height - height > _TINY or page.joined:
        for y in (bottom, top):
            canvas.line(left - 1, y, left - 7, y)
            canvas.line(right + 1, y, right + 7, y)


def _draw_rulers(canvas: Canvas, page: Page, zero: tuple[float, float]) -> None:
    """In mm along the lower and the left edge, from a place on the board on."""
    window = page.window
    (left, bottom), _ = _corners(page)
    canvas.setFont(_FONT, _SMALL)
    for at, value, tick in _ticks(window.left, window.right, zero[0]):
        x, _ = page.place(at, 0)
        canvas.line(x, bottom, x, bottom - tick)
        if value % 10 == 0:
            canvas.drawCentredString(x, bottom - 6.3, str(value))
    for at, value, tick in _ticks(window.bottom, window.top, zero[1]):
        _, y = page.place(0, at)
        canvas.line(left, y, left - tick, y)
        if value % 10 == 0:
            canvas.saveState()
            canvas.translate(left - 4.6, y)
            canvas.rotate(90)
            canvas.drawCentredString(0, 0, str(value))
            canvas.restoreState()


def _ticks(start: float, end: float, zero: float) -> Iterator[tuple[float, int, float]]:
    """Places of a ruler's ticks, their values, and their lengths."""
    for value in range(int(np.ceil(start - zero - _TINY)), int(np.floor(end - zero + _TINY)) + 1):
        yield zero + value, value, next(length for step, length in _TICKS.items() if value % step == 0)


def _draw_joints(canvas: Canvas, page: Page) -> None:
    """Arrowheads in the margins that point at the line where the edge of the next page comes to lie."""
    (left, bottom), (right, top) = _corners(page)
    for joint in page.joints[0]:
        x, _ = page.place(joint, 0)
        _draw_arrow(canvas, (x, bottom), (0, -1))
        _draw_arrow(canvas, (x, top), (0, 1))
    for joint in page.joints[1]:
        _, y = page.place(0, joint)
        _draw_arrow(canvas, (left, y), (-1, 0))
        _draw_arrow(canvas, (right, y), (1, 0))


def _draw_arrow(canvas: Canvas, tip: tuple[float, float], back: tuple[float, float]) -> None:
    """A filled triangle whose other side lies in the direction ``back``."""
    (x, y), (dx, dy) = tip, (_ARROW * back[0], _ARROW * back[1])
    path = canvas.beginPath()
    path.moveTo(x, y)
    path.lineTo(x + dx - dy / 3, y + dy + dx / 3)
    path.lineTo(x + dx + dy / 3, y + dy - dx / 3)
    path.close()
    canvas.drawPath(path, stroke=0, fill=1)


def _draw_words(canvas: Canvas, board: Board, page: Page, count: int) -> None:
    (left, _), (right, _) = _corners(page)
    advice = "print at 100 % and check the rulers"
    _draw_line(canvas, (left, _CAPTION), right - left, f"calgraph: {caption(board)}; {advice}", _SMALL)
    if count > 1:
        label = f"page {page.label} of {count}"
        if seams := _seams(page):
            label += f": cut along its {' and '.join(seams)}, up to the arrowheads"
        _draw_line(canvas, (left, page.paper.height - _LABEL), right - left, label, _LARGE)


def _seams(page: Page) -> list[str]:
    """Which edges are cut and glued over which neighbours."""
    seams = []
    if page.column:
        seams.append(f"left edge and glue it over {replace(page, column=page.column - 1).label}")
    if page.row:
        seams.append(f"upper edge and glue it over {replace(page, row=page.row - 1).label}")
    return seams


def _draw_line(canvas: Canvas, place: tuple[float, float], width: float, text: str, size: float) -> None:
    """A line of text, in smaller letters if it is too long."""
    needed = canvas.stringWidth(text, _FONT, size)
    canvas.setFont(_FONT, size * min(1.0, width / needed))
    canvas.drawString(*place, text)


def _corners(page: Page) -> tuple[tuple[float, float], tuple[float, float]]:
    """The lower left and the upper right corner of what is shown of the board, on the page."""
    window = page.window
    return page.place(window.left, window.bottom), page.place(window.right, window.top)

"""The PDF of boards: black rectangles at true scale, with rulers, cut marks, overlap marks, and captions."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import FILL_EVEN_ODD, Canvas

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard
from calgraph.io.atomic import write_atomically
from calgraph.printing.pages import MM_PER_METER, Page, black_rectangles_mm

_HAIRLINE = 0.1
"""Width of all lines, mm."""
_ROUNDING = 1e-6
"""Rounding, mm."""
_FONT, _SMALL, _LARGE = "Helvetica", 2.1, 2.6
"""Font, and font sizes in mm."""
_TICKS = {10: 4.0, 5: 3.0, 1: 1.8}
"""Lengths of a ruler's ticks, mm, by the multiple that they mark, mm."""
_CAPTION_BASELINE, _LABEL_BASELINE = 5.2, 7.2
"""Baselines of the caption and of the page's label, from the lower and the upper edge of the page, mm."""
_ARROW_LENGTH = 3.5
"""Length of the arrowheads that mark the edges of the next pages, mm."""


def write_pdf(path: Path, boards: Sequence[tuple[Board, Sequence[Page]]]) -> None:
    """Writes the pages of boards, one board after the other; the same boards give the same file.

    Raises:
        InputError: ``path`` cannot be written.
    """
    with write_atomically(path) as temporary:
        canvas = Canvas(str(temporary), invariant=1, pageCompression=1)
        canvas.setTitle("calgraph board")
        canvas.setCreator("calgraph")
        # Otherwise viewers scale the page to the paper.
        canvas.setViewerPreference("PrintScaling", "None")
        for board, pages in boards:
            for page in pages:
                _draw_page(canvas, board, page, len(pages))
                canvas.showPage()
        canvas.save()


def describe_board(board: Board) -> str:
    """Print and size of a board in one line."""
    width, height = (_format_mm(length) for length in board.size)
    inverted = ", inverted" if board.inverted else ""
    return f"{_describe_print(board)}{inverted}; board {width} x {height} mm"


def _describe_print(board: Board) -> str:
    match board.pattern:
        case None if not board.tags:
            return "nothing printed"
        case None:
            sizes = sorted({tag.size for tag in board.tags})
            ids = ", ".join(str(tag.id) for tag in board.tags)
            return f"{board.family}, ids {ids}, tags of {' and '.join(_format_mm(size) for size in sizes)} mm"
        case Checkerboard() as p:
            return f"checkerboard, {p.columns} x {p.rows} inner corners, squares of {_format_mm(p.square)} mm"
        case Charuco() as p:
            lengths = (
                f"squares of {_format_mm(p.square)} mm, markers of {_format_mm(p.marker)} mm from {p.first_id}"
            )
            return f"ChArUco, {p.dictionary}, {p.columns} x {p.rows} squares, {lengths}"
        case AprilGrid() as p:
            lengths = f"tags of {_format_mm(p.tag_size)} mm from {p.first_id}, spacing {p.tag_spacing:g}"
            return f"AprilGrid, {board.family}, {p.columns} x {p.rows}, {lengths}"


def _format_mm(length: float) -> str:
    return f"{MM_PER_METER * length:.5g}"


def _draw_page(canvas: Canvas, board: Board, page: Page, count: int) -> None:
    canvas.setPageSize((page.paper.width * mm, page.paper.height * mm))
    canvas.scale(mm, mm)
    canvas.setLineWidth(_HAIRLINE)
    _draw_print(canvas, board, page)
    _draw_cut_marks(canvas, board, page)
    _draw_rulers(canvas, page, (page.window.left, page.window.bottom) if count == 1 else (0.0, 0.0))
    _draw_overlap_marks(canvas, page)
    _draw_text(canvas, board, page, count)


def _draw_print(canvas: Canvas, board: Board, page: Page) -> None:
    """Draws the print as one path: separately filled rectangles show seams where they touch."""
    window, black = page.window, black_rectangles_mm(board)
    low = np.maximum(black[:, :2], [window.left, window.bottom])
    high = np.minimum(black[:, 2:], [window.right, window.top])
    visible = (low < high).all(axis=1)
    path = canvas.beginPath()
    if board.inverted:
        # With the even-odd rule, the rectangles are holes in the black of the board.
        path.rect(*page.to_page(window.left, window.bottom), window.width, window.height)
    for (left, bottom), (width, height) in zip((low + page.origin)[visible], (high - low)[visible], strict=True):
        path.rect(float(left), float(bottom), float(width), float(height))
    canvas.drawPath(path, stroke=0, fill=1, fillMode=FILL_EVEN_ODD)


def _draw_cut_marks(canvas: Canvas, board: Board, page: Page) -> None:
    """Draws cut marks outside of the print; none where the board is as large as the paper."""
    (left, bottom), (right, top) = _window_corners(page)
    width, height = (MM_PER_METER * length for length in board.size)
    if page.paper.width - width > _ROUNDING or page.is_tile:
        for x in (left, right):
            canvas.line(x, bottom - 1, x, bottom - 7)
            canvas.line(x, top + 1, x, top + 7)
    if page.paper.height - height > _ROUNDING or page.is_tile:
        for y in (bottom, top):
            canvas.line(left - 1, y, left - 7, y)
            canvas.line(right + 1, y, right + 7, y)


def _draw_rulers(canvas: Canvas, page: Page, zero: tuple[float, float]) -> None:
    """Draws rulers in mm along the lower and the left edge, with zero at a point on the board."""
    window = page.window
    (left, bottom), _ = _window_corners(page)
    canvas.setFont(_FONT, _SMALL)
    for at, value, tick in _ruler_ticks(window.left, window.right, zero[0]):
        x, _ = page.to_page(at, 0)
        canvas.line(x, bottom, x, bottom - tick)
        if value % 10 == 0:
            canvas.drawCentredString(x, bottom - 6.3, str(value))
    for at, value, tick in _ruler_ticks(window.bottom, window.top, zero[1]):
        _, y = page.to_page(0, at)
        canvas.line(left, y, left - tick, y)
        if value % 10 == 0:
            canvas.saveState()
            canvas.translate(left - 4.6, y)
            canvas.rotate(90)
            canvas.drawCentredString(0, 0, str(value))
            canvas.restoreState()


def _ruler_ticks(start: float, end: float, zero: float) -> Iterator[tuple[float, int, float]]:
    """Positions, values and lengths of a ruler's ticks, mm."""
    for value in range(int(np.ceil(start - zero - _ROUNDING)), int(np.floor(end - zero + _ROUNDING)) + 1):
        yield zero + value, value, next(length for step, length in _TICKS.items() if value % step == 0)


def _draw_overlap_marks(canvas: Canvas, page: Page) -> None:
    """Draws arrowheads in the margins at the edges of the next pages."""
    (left, bottom), (right, top) = _window_corners(page)
    for joint in page.overlap_edges[0]:
        x, _ = page.to_page(joint, 0)
        _draw_arrow(canvas, (x, bottom), (0, -1))
        _draw_arrow(canvas, (x, top), (0, 1))
    for joint in page.overlap_edges[1]:
        _, y = page.to_page(0, joint)
        _draw_arrow(canvas, (left, y), (-1, 0))
        _draw_arrow(canvas, (right, y), (1, 0))


def _draw_arrow(canvas: Canvas, tip: tuple[float, float], back: tuple[float, float]) -> None:
    """Draws a filled triangle with its tip at ``tip`` and its base in the direction ``back``."""
    (x, y), (dx, dy) = tip, (_ARROW_LENGTH * back[0], _ARROW_LENGTH * back[1])
    path = canvas.beginPath()
    path.moveTo(x, y)
    path.lineTo(x + dx - dy / 3, y + dy + dx / 3)
    path.lineTo(x + dx + dy / 3, y + dy - dx / 3)
    path.close()
    canvas.drawPath(path, stroke=0, fill=1)


def _draw_text(canvas: Canvas, board: Board, page: Page, count: int) -> None:
    (left, _), (right, _) = _window_corners(page)
    advice = "print at 100 % and check the rulers"
    _draw_text_line(
        canvas, (left, _CAPTION_BASELINE), right - left, f"calgraph: {describe_board(board)}; {advice}", _SMALL
    )
    if count > 1:
        label = f"page {page.label} of {count}"
        if seams := _describe_seams(page):
            label += f": cut along the {' and '.join(seams)}, up to the arrowheads"
        _draw_text_line(canvas, (left, page.paper.height - _LABEL_BASELINE), right - left, label, _LARGE)


def _describe_seams(page: Page) -> list[str]:
    """Edges that are cut and glued over neighbouring pages."""
    seams = []
    if page.column:
        seams.append(f"left edge and glue it over {replace(page, column=page.column - 1).label}")
    if page.row:
        seams.append(f"upper edge and glue it over {replace(page, row=page.row - 1).label}")
    return seams


def _draw_text_line(canvas: Canvas, place: tuple[float, float], width: float, text: str, size: float) -> None:
    """Draws a line of text, with a smaller font if it is too long."""
    needed = canvas.stringWidth(text, _FONT, size)
    canvas.setFont(_FONT, size * min(1.0, width / needed))
    canvas.drawString(*place, text)


def _window_corners(page: Page) -> tuple[tuple[float, float], tuple[float, float]]:
    """The lower left and the upper right corner of the page's window, on the page."""
    window = page.window
    return page.to_page(window.left, window.bottom), page.to_page(window.right, window.top)

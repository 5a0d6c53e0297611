"""``calgraph board``: boards as PDF, and the target of rig.yaml that belongs to them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from calgraph.cli.console import console
from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.config import Board
from calgraph.errors import InputError
from calgraph.io.atomic import check_output_path, write_text
from calgraph.printing import (
    DEFAULT_SIZE,
    BoardOptions,
    Page,
    Paper,
    choose_paper,
    design_board,
    format_target,
    layout_pages,
    parse_paper,
    parse_size,
    read_boards,
    replace_target,
)
from calgraph.printing.pages import black_rectangles_mm

_MAX_OFFICE_PAPER = 420.0
"""mm: longer paper than A3 does not go into the printers of offices."""
_MODEL_OPTIONS = {option.parameter: option for option in list_options(BoardOptions, {"kind": "Print"})}


def board_options(
    rig: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RIG]", help="Print the boards of this rig.yaml, or of a file with only a target."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="PDF to write.")] = Path("board.pdf"),
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Of the board, mm; if left out, as large as the paper given, or 1200x900 without."
        ),
    ] = None,
    paper: Annotated[
        str | None,
        typer.Option(
            metavar="PAPER",
            help="One page of A5 to A0, letter, legal, tabloid, ansi-c to ansi-e, or WxH in mm, turned as it "
            "suits. If left out, the smallest of A4 to A0 that takes the board, or a page of the board's size "
            "for a print shop; fit: always such a page.",
        ),
    ] = None,
    tile: Annotated[
        str | None, typer.Option(metavar="PAPER", help="Spread the board over pages of this paper, to be joined.")
    ] = None,
    overlap: Annotated[float, typer.Option(metavar="MM", help="Overlap of pages to be joined, mm.")] = 10.0,
    into: Annotated[
        Path | None, typer.Option(metavar="RIG", help="Also replace the target: of this rig.yaml.")
    ] = None,
    **options: Any,
) -> None:
    """Make a printable board: a PDF at true scale, and on stdout the matching target: of rig.yaml.

    Print at 100 %, check the rulers on the print, and glue it to something flat and stiff.
    """
    check_output_path(out)
    if paper and tile:
        raise InputError("--tile: spreads the board over pages, --paper is for one page; give one of them")
    fit = bool(paper) and str(paper).strip().lower() == "fit"
    given = parse_paper(paper or tile or "") if (paper and not fit) or tile else None
    if rig is None:
        boards: tuple[Board, ...] = (
            design_board(
                _board_size(size, given if paper else None), apply_options(BoardOptions(), _MODEL_OPTIONS, options)
            ),
        )
    elif size is None and not options:
        boards = read_boards(rig)
    else:
        raise InputError(f"{rig}: defines the boards to print; give either it, or options of another")
    pages = [(one, layout_pages(one, given or (None if fit else choose_paper(one)), overlap)) for one in boards]
    if not tile:
        _check_single(pages, paper)
    changed = replace_target(into, boards) if into else ""

    from calgraph.printing.pdf import write_pdf  # its library takes a while, which --help should not

    write_pdf(out, pages)
    if into:
        write_text(into, changed)
    typer.echo(format_target(boards), nl=False)
    console(stderr=True).print(
        f"Wrote {out}: {_describe([page for _, of_one in pages for page in of_one])}{_name_blank(pages)}",
        markup=False,
    )


def _board_size(size: str | None, paper: Paper | None) -> tuple[float, float]:
    """Width and height of the requested board, mm."""
    if size is not None:
        return parse_size(size, "--size: must be")
    if paper is None:
        return DEFAULT_SIZE
    return max(paper.width, paper.height), min(paper.width, paper.height)


def _check_single(pages: Sequence[tuple[Board, Sequence[Page]]], paper: str | None) -> None:
    """Raises InputError if a board does not fit on one page."""
    for board, of_one in pages:
        if len(of_one) > 1:
            width, height = (1000 * length for length in board.size)
            raise InputError(
                f"--paper: a board of {width:g}x{height:g} mm does not fit on one page of {paper}; leave --paper "
                f"out for one page of its size, or give --tile {paper} for {len(of_one)} pages to be joined"
            )


def _describe(pages: Sequence[Page]) -> str:
    """Number and size of the pages, and how to print them."""
    count, paper = len(pages), pages[0].paper
    size = f"{count} page{'s'[: count > 1]} of {paper.width:g}x{paper.height:g} mm"
    if any(page.is_tile for page in pages):
        return f"{size}, to be joined; print at 100 %"
    is_large = max(paper.width, paper.height) > _MAX_OFFICE_PAPER
    shop = " in a print shop, or give --tile A4 for pages to be joined" if is_large else ""
    return f"{size}; print at 100 %{shop}"


def _name_blank(pages: Sequence[tuple[Board, Sequence[Page]]]) -> str:
    """Which pages have rulers only, and need no paper where the board is white."""
    blank = []
    for of_board, of_one in pages:
        left, bottom, right, top = black_rectangles_mm(of_board).T
        for page in of_one:
            across = (left < page.window.right) & (right > page.window.left)
            if not np.any(across & (bottom < page.window.top) & (top > page.window.bottom)):
                blank.append(page.label)
    return f"; without print, to be left out on a white board: {', '.join(blank)}" if blank else ""


board = add_options(board_options, _MODEL_OPTIONS, BoardOptions())
"""The command; options of the print are the fields of :class:`BoardOptions`."""

"""``calgraph board``: boards as PDF, and the target of rig.yaml that belongs to them."""

from pathlib import Path
from typing import Annotated, Any

import typer

from calgraph.cli.console import console
from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.config import Board
from calgraph.errors import InputError
from calgraph.io import check_output_path, write_text
from calgraph.printing import (
    BoardOptions,
    Paper,
    design_board,
    format_target,
    layout_pages,
    parse_paper,
    parse_size,
    read_boards,
    replace_target,
)

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
        typer.Option(metavar="WxH", help="Of the board, mm; as large as the paper, lying, if left out."),
    ] = None,
    paper: Annotated[
        str,
        typer.Option(
            metavar="PAPER",
            help="A5 to A0, letter, legal, tabloid, ansi-c to ansi-e, or WxH in mm, turned as it suits; a larger "
            "board is spread over pages to be joined. Or fit: one page as large as the board needs.",
        ),
    ] = "A4",
    overlap: Annotated[float, typer.Option(metavar="MM", help="Of pages to be joined.")] = 10.0,
    into: Annotated[
        Path | None,
        typer.Option(metavar="RIG", help="Put the target: into this rig.yaml, too, replacing the one in it."),
    ] = None,
    **options: Any,
) -> None:
    """Make a printable board: a PDF at true scale, and on stdout the target: that rig.yaml needs for it.

    Print at 100 %, check the rulers on the print, and glue it to something flat and stiff.
    """
    check_output_path(out)
    chosen = None if paper.strip().lower() == "fit" else parse_paper(paper)
    if rig is None:
        boards: tuple[Board, ...] = (
            design_board(_board_size(size, chosen), apply_options(BoardOptions(), _MODEL_OPTIONS, options)),
        )
    elif size is None and not options:
        boards = read_boards(rig)
    else:
        raise InputError(f"{rig}: defines the boards to print; give either it, or options of another")
    pages = [(one, layout_pages(one, chosen, overlap)) for one in boards]
    changed = replace_target(into, boards) if into else ""

    from calgraph.printing.pdf import write_pdf  # its library takes a while, which --help should not

    write_pdf(out, pages)
    if into:
        write_text(into, changed)
    typer.echo(format_target(boards), nl=False)
    count = sum(len(of_one) for _, of_one in pages)
    console(stderr=True).print(f"Wrote {out}: {count} page{'s'[: count > 1]}; print at 100 %", markup=False)


def _board_size(size: str | None, paper: Paper | None) -> tuple[float, float]:
    """Width and height of the requested board, mm."""
    if size is not None:
        return parse_size(size, "--size: must be")
    if paper is None:
        raise InputError("--size: is needed for --paper fit, which is as large as the board")
    return max(paper.width, paper.height), min(paper.width, paper.height)


board = add_options(board_options, _MODEL_OPTIONS, BoardOptions())
"""The command; what there is to choose of a print is read off :class:`Wishes`."""

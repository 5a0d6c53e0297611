"""Where commands print: wrapped on a terminal, whole lines anywhere else."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

_UNWRAPPED = 10_000


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Leaves it to the launcher: rich would exit with 1, which here means "not calibrated"."""
        raise BrokenPipeError


def console(*, stderr: bool = False) -> Console:
    """A console on stdout or stderr; as wide as the terminal, or as what is printed where there is none."""
    # Colons in paths and names are no emoji.
    plain = _Console(stderr=stderr, highlight=False, emoji=False)
    if plain.is_terminal:
        return plain
    return _Console(stderr=stderr, highlight=False, emoji=False, width=_UNWRAPPED)


def make_table(
    names: Iterable[str], numbers: Iterable[str], rows: Iterable[Iterable[str]], *, gap: int = 1
) -> Table:
    """A table without lines.

    Args:
        names: heads of the first columns, whose names are folded where they are too long for the terminal.
        numbers: heads of the others.
        rows: cells, with markup.
        gap: spaces between two columns.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, gap - 1), header_style="bold")
    for head in names:
        table.add_column(head, overflow="fold")
    for head in numbers:
        table.add_column(head, justify="right", no_wrap=True)
    for cells in rows:
        table.add_row(*cells)
    return table

"""Where commands print: wrapped on a terminal, whole lines anywhere else."""

from rich.console import Console

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

"""The commands' home, and the launcher that turns known errors into one line and an exit code."""

import functools
import logging
import os
import signal
import sys
from collections.abc import Callable
from importlib.metadata import version
from types import FrameType
from typing import Annotated

import typer
from rich.markup import escape

from calgraph.cli.board import board
from calgraph.cli.calibrate import calibrate
from calgraph.cli.check import check
from calgraph.cli.console import console
from calgraph.cli.demo import demo
from calgraph.cli.export import export
from calgraph.cli.init import init
from calgraph.cli.inspect import inspect
from calgraph.cli.simulate import simulate_rig_command
from calgraph.cli.simulate_network import simulate_network_command
from calgraph.cli.solve import solve
from calgraph.cli.verify import verify
from calgraph.cli.view import view
from calgraph.errors import CalgraphError, InputError

_INTERRUPTED, _BROKEN_PIPE, _TERMINATED = (128 + number for number in (2, 13, 15))
"""Exit codes as shells give them for SIGINT, SIGPIPE and SIGTERM."""


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """A command that ends quietly when interrupted, and in a line and an exit code on known errors.

    Exit codes: 1 for what the data do not determine, 2 for bad input.
    """

    @functools.wraps(command)
    def run(*args: object, **options: object) -> None:
        try:
            command(*args, **options)
            sys.stdout.flush()
        except CalgraphError as error:
            _complain(error)
            raise typer.Exit(2 if isinstance(error, InputError) else 1) from None
        except KeyboardInterrupt:
            raise typer.Exit(_INTERRUPTED) from None
        except BrokenPipeError:
            # The interpreter flushes stdout once more at its end, and would complain of the pipe then.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(_BROKEN_PIPE) from None

    return run


app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
simulate = typer.Typer(no_args_is_help=True, help="Simulate recordings with known truth.")
app.command()(guarded(calibrate))
app.command()(guarded(solve))
app.command()(guarded(check))
app.command()(guarded(verify))
app.command()(guarded(demo))
app.command()(guarded(init))
app.command("board")(guarded(board))
app.command()(guarded(inspect))
app.command()(guarded(export))
app.command()(guarded(view))
simulate.command("rig")(guarded(simulate_rig_command))
simulate.command("network")(guarded(simulate_network_command))
app.add_typer(simulate, name="simulate")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"calgraph {version('calgraph')}")
        raise typer.Exit


@app.callback()
def calgraph(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Find where cameras, laser scanners and LiDARs are, relative to each other, from one recording."""
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="calgraph: %(message)s")


def main() -> None:
    """Runs the command given; exit code 0, 1 (not calibrated) or 2 (bad usage or input)."""
    signal.signal(signal.SIGTERM, _terminate)
    app()


def _terminate(_number: int, _frame: FrameType | None) -> None:
    """Ends as an error does, so that unfinished files are removed on the way out."""
    sys.exit(_TERMINATED)


def _complain(error: CalgraphError) -> None:
    stderr = console(stderr=True)
    for line in str(error).splitlines():
        stderr.print(f"[bold red]calgraph:[/] {escape(line)}", soft_wrap=True)

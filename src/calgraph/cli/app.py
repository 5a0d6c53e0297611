"""The commands' home, and the launcher that turns known errors into one line and an exit code."""

import logging
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calgraph.cli import calibrate, demo, export, init, inspect, simulate
from calgraph.errors import CalgraphError, InputError

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
    help="Finds where cameras, laser scanners and LiDARs are, relative to each other, from one recording.",
)  # fmt: skip
app.command("calibrate")(calibrate.calibrate)
app.command("demo")(demo.demo)
app.command("init")(init.init)
app.command("inspect")(inspect.inspect)
app.command("export")(export.export)


@app.callback()
def _settings(verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens.")] = False) -> None:
    logging.basicConfig(level=logging.INFO if verbose else logging.ERROR, format="%(name)s: %(message)s")


def main() -> None:
    """Runs the command given; exit code 0, 1 (not calibrated) or 2 (bad usage or input)."""
    commands = typer.main.get_command(app)
    simulate.add_to(commands)
    try:
        commands(standalone_mode=True)
    except InputError as error:
        _complain(error, 2)
    except CalgraphError as error:
        _complain(error, 1)


def _complain(error: CalgraphError, code: int) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"[bold red]calgraph:[/] {escape(str(error))}")
    sys.exit(code)

"""The list of commands, and the launcher that reports expected errors in one line with an exit code."""

import codecs
import ctypes
import functools
import gc
import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Annotated

import typer
from rich.markup import escape

from calgraph.cli.console import console
from calgraph.cli.lazy_commands import LazyCommand, lazy_group
from calgraph.cli.progress import VerboseOption, log_steps
from calgraph.errors import CalgraphError, CalibrationError, InputError

_BROKEN_PIPE = 128 + 13
"""Exit code as shells give it for SIGPIPE."""
# Objects between two searches for reference cycles, which find none worth their time while modules are loaded: by
# default, they take a tenth of it. At some 100 bytes an object, these are 20 MB.
_ALLOCATIONS_PER_COLLECTION = 200_000
# mallopt(3): bytes of freed memory at the end of the heap that are kept, and of an array that has separate memory.
# By default, glibc returns arrays above 128 kB to the system, which clears memory for the next one: 150,000 page
# faults, half a second, in a rig's calibration. The most memory in use stays the same.
_MALLOC_SETTINGS = {-1: 64 * 2**20, -3: 16 * 2**20}


def handle_errors(command: Callable[..., None]) -> Callable[..., None]:
    """A command that reports expected errors in a line with an exit code.

    Exit codes: 1 for what the data do not determine, 2 for bad input.
    """

    @functools.wraps(command)
    def run(*args: object, **options: object) -> None:
        try:
            command(*args, **options)
        except CalgraphError as error:
            _print_error(error)
            raise typer.Exit(2 if isinstance(error, InputError) else 1) from None

    return run


# In the order of the work with them.
_PAGES = {
    "demo": "quickstart", "board": "boards", "plan": "recording", "live": "live", "inspect": "formats",
    "init": "quickstart", "intrinsics": "rigs", "calibrate": "quickstart", "view": "use", "export": "use",
    "check": "audit", "fleet": "fleet", "verify": "reliability", "solve": "formats", "docs": "quickstart",
    "cache": "formats",
}  # fmt: skip
"""What ``calgraph docs`` has on a command."""
COMMANDS = {
    name: LazyCommand(f"calgraph.cli.{name}", name, summary, _PAGES[name])
    for name, summary in {
        "demo": "Simulate a five-sensor robot, calibrate it, and compare with the ground truth.",
        "board": "Make a printable board: a PDF at true scale, and on stdout the matching target: of rig.yaml.",
        "plan": "Predict the errors of a rig's poses before recording, and list the best places for the board.",
        "live": "Record a running robot, watch sensors and captures on a phone, and calibrate.",
        "inspect": "Show the topics of a recording, or how a result was computed.",
        "init": "Draft a rig.yaml from the topics of a recording, with comments on what to check and to measure.",
        "intrinsics": "Estimate the intrinsics of cameras from images of a board, which may move.",
        "calibrate": "Estimate the relative poses of all sensors of a rig, a network, or a robot that drives.",
        "view": "Show a calibration in the browser: sensors, measurements, and residuals when one is moved.",
        "export": "Write a calibration as launch file, tf2 YAML, URDF, Kalibr camchain, ROS camera_info, "
        "corrections or JSON.",
        "check": "Check given extrinsics of a rig or network by a recording: pass, warn or fail, by sensor and "
        "axis, and why.",
        "fleet": "Calibrate or check the recordings of many robots, and report which sensor of which robot moved "
        "when.",
        "verify": "Test the covariances of a rig's calibration by a bootstrap over its captures.",
        "solve": "Repeat the joint solution from the problem that calibrate --dump wrote.",
        "docs": "List the pages of the documentation, or print one.",
        "cache": "Show where detections are kept for later runs, and their size; or remove them.",
    }.items()
}
SIMULATIONS = {
    "rig": LazyCommand(
        "calgraph.cli.simulate",
        "simulate_rig_command",
        "Simulate a robot, a board, and an operator who carries it around; write recording and ground truth.",
        "quickstart",
    ),
    "drive": LazyCommand(
        "calgraph.cli.simulate_drive",
        "simulate_drive_command",
        "Simulate a robot that drives; write recording, rig.yaml and ground truth.",
        "driving",
    ),
    "network": LazyCommand(
        "calgraph.cli.simulate_network",
        "simulate_network_command",
        "Simulate scanners in a building, and people who walk through; write recording and ground truth.",
        "buildings",
    ),
}

app = typer.Typer(
    cls=lazy_group(COMMANDS, handle_errors),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    epilog="Guides: calgraph docs; first calgraph docs quickstart, after a message calgraph docs troubleshooting.",
)
simulate = typer.Typer(
    cls=lazy_group(SIMULATIONS, handle_errors), no_args_is_help=True, help="Simulate recordings with ground truth."
)
app.add_typer(simulate, name="simulate")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"calgraph {version('calgraph')}")
        raise typer.Exit


@app.callback()
def calgraph(
    verbose: VerboseOption = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Estimate the extrinsics of cameras, laser scanners and LiDARs from one recording."""
    logging.basicConfig(level=logging.WARNING, format="calgraph: %(message)s", force=True)
    if verbose:
        log_steps()


def run_command_line() -> None:
    """Runs the command given, and ends the process with its exit code."""
    gc.set_threshold(_ALLOCATIONS_PER_COLLECTION)
    _limit_library_threads()
    _keep_freed_memory()
    open_standard_streams()
    try:
        try:
            _check_no_argument_is_empty(sys.argv)
            app()
        finally:
            # Here, as what remains in the buffer is otherwise written, and fails, after the exit code is given.
            sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
        sys.exit(_BROKEN_PIPE)
    except (MemoryError, ImportError) as error:
        # The loader's words for a library that does not fit into memory.
        if isinstance(error, ImportError) and "failed to map segment" not in str(error):
            raise
        _print_error(CalibrationError("memory ran out; reduce `jobs`, or give a shorter recording"))
        sys.exit(1)
    except InputError as error:
        _print_error(error)
        sys.exit(2)
    except OSError as error:
        # Files are named by the error; where none is, this is the stream.
        place = f"{error.filename}: cannot be used" if error.filename else "standard output: cannot be written"
        discard_output()
        _print_error(InputError(f"{place} ({error.strerror or error})"))
        sys.exit(2)


def _check_no_argument_is_empty(arguments: Sequence[str]) -> None:
    for before, argument in pairwise(arguments):
        if not argument:
            place = before if before.startswith("-") else "an argument"
            raise InputError(f"{place}: is empty, perhaps an unset variable; give a path or a value")


def _limit_library_threads() -> None:
    """Lets NumPy and OpenCV, which are not imported yet, use one thread each, unless the environment states more.

    Their matrices and images are small here: further threads wait for each other, on a busy machine for most of
    the time, and results depend on their number in the last bits. ``--jobs`` divides the work among processes.
    """
    for variable in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(variable, "1")


def _keep_freed_memory() -> None:
    if sys.platform == "linux":
        # Other C libraries than glibc lack the function.
        with suppress(AttributeError):
            mallopt = ctypes.CDLL(None).mallopt
            for setting, size in _MALLOC_SETTINGS.items():
                mallopt(setting, size)


def _print_error(error: CalgraphError) -> None:
    stderr = console(stderr=True)
    # The library names its parameters in backticks; on the command line they are options.
    message = re.sub(r"`(\w+)`", lambda match: _option(match[1]), str(error))
    # Where stderr cannot be written either, the exit code is the message.
    with suppress(OSError):
        for line in message.splitlines():
            stderr.print(f"[bold red]calgraph:[/] {escape(line)}", soft_wrap=True)


def _option(parameter: str) -> str:
    """The command line option that sets a parameter of the library."""
    return "--" + {"keep": "filter"}.get(parameter, parameter.replace("_", "-"))


_ASCII_SIGNS = {
    "±": "+/-", "°": " deg", "σ": "sigma", "✓": "ok", "✕": "x", "∞": "inf", "–": "-", "—": "-", "…": "...",
    "×": "x", "µ": "u", "²": "^2", "χ": "chi", "≤": "<=", "≥": ">=", "→": "->", "━": "-", "╸": "-", "╺": "-",
}  # fmt: skip
"""What is printed for signs that the terminal's encoding lacks; others become JSON's escapes, \\u03c3."""
_ERROR_HANDLER = "calgraph_ascii"


def open_standard_streams() -> None:
    """Makes standard output and standard error accept all texts, for any encoding of the terminal.

    Descriptors that are closed (``>&-``) are opened on the null device: otherwise the next file that is opened,
    such as a result, takes their number, and what libraries print goes into it.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    # The interpreter has no stream for a closed descriptor.
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
    codecs.register_error(_ERROR_HANDLER, _replace_unencodable)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors=_ERROR_HANDLER)  # type: ignore[union-attr]


def discard_output() -> None:
    """Sends standard output to the null device: the interpreter flushes it once more at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    """The handler of characters that an encoding lacks, as :func:`codecs.register_error` asks for it."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    characters = error.object[error.start : error.end]
    return "".join(_ASCII_SIGNS.get(one) or _escape(one) for one in characters), error.end


def _escape(character: str) -> str:
    """A character as in JSON: as one or two units of UTF-16."""
    units = character.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[i : i + 4]}" for i in range(0, len(units), 4))

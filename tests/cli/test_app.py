"""The launcher: help, version, pipes and interruptions."""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from calgraph.cli.app import COMMANDS, SIMULATIONS, app, handle_errors
from calgraph.cli.lazy_commands import LazyCommand
from calgraph.errors import CalibrationError, InputError, RecordingError

Run = Callable[..., Result]


def guarded_exit(error: BaseException) -> Result:
    def command() -> None:
        raise error

    small = typer.Typer()
    small.command()(handle_errors(command))
    return CliRunner().invoke(small)


def test_the_version_is_that_of_the_package(run: Run) -> None:
    assert run("--version").stdout == f"calgraph {version('calgraph')}\n"


def test_alone_it_shows_its_commands(run: Run) -> None:
    text = run().output
    commands = ("calibrate", "solve", "demo", "init", "inspect", "export", "simulate")
    assert [name for name in commands if f"│ {name} " not in text] == []


@pytest.mark.parametrize(
    "command", [["calibrate"], ["solve"], ["demo"], ["init"], ["inspect"], ["export"], ["simulate", "rig"]]
)
def test_every_command_has_help_within_80_columns(command: list[str]) -> None:
    result = CliRunner(env={"COLUMNS": "80"}).invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    assert max(map(len, result.output.splitlines())) <= 80


@pytest.mark.parametrize("place", [*COMMANDS.values(), *SIMULATIONS.values()], ids=lambda place: place.function)
def test_the_list_of_commands_has_the_first_line_of_their_help(place: LazyCommand) -> None:
    assert (place.load().__doc__ or "").splitlines()[0] == place.summary


def test_the_list_of_commands_waits_for_none_of_them() -> None:
    """It takes a quarter of a second; NumPy alone as long again."""
    code = "import sys; from calgraph.cli.app import app; app(['--help'], standalone_mode=False); {}"
    heavy = "sys.exit(', '.join({'numpy', 'scipy', 'pydantic', 'rosbags', 'ruamel.yaml'} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code.format(heavy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr.strip() == ""
    assert "calibrate" in done.stdout


@pytest.mark.parametrize(
    ("error", "code"),
    [(CalibrationError("why"), 1), (InputError("why"), 2), (RecordingError("why"), 2), (KeyboardInterrupt(), 130)],
)
def test_expected_errors_have_their_exit_code(error: BaseException, code: int) -> None:
    assert guarded_exit(error).exit_code == code


def test_every_line_of_an_error_starts_with_the_program() -> None:
    assert guarded_exit(InputError("a: b\nc: [d]")).stderr == "calgraph: a: b\ncalgraph: c: [d]\n"


def test_long_errors_stay_on_one_line_where_there_is_no_terminal() -> None:
    assert guarded_exit(InputError("word " * 100)).stderr.count("\n") == 1


def test_unexpected_errors_are_not_hidden() -> None:
    assert isinstance(guarded_exit(ZeroDivisionError()).exception, ZeroDivisionError)


def test_a_reader_that_goes_away_ends_it_quietly(simulated: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    code = "from calgraph.cli import main; main()"
    with os.fdopen(write) as stdout:
        done = subprocess.run(
            [sys.executable, "-c", code, "inspect", str(simulated / "recording")],
            stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (141, "")

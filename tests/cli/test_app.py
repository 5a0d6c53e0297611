"""The launcher: help, version, pipes and interruptions."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from itertools import pairwise
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


def test_commands_are_in_the_order_of_the_work() -> None:
    order = ("board", "live", "inspect", "init", "calibrate", "view", "export", "check")
    assert [name for name in COMMANDS if name in order] == list(order)


def help_of(*command: str) -> str:
    """The help of a command on a terminal of 80 columns."""
    result = CliRunner(env={"COLUMNS": "80"}).invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    return result.output


@pytest.mark.parametrize(
    "command", [*([name] for name in COMMANDS), *(["simulate", name] for name in SIMULATIONS)]
)
def test_every_command_has_help_within_80_columns(command: list[str]) -> None:
    lines = [line.rstrip() for line in help_of(*command).splitlines()]
    assert max(map(len, lines)) <= 80
    assert not re.search("<bool>|<path>|list\\[|int range", "\n".join(lines))


@pytest.mark.parametrize("command", [*COMMANDS, "simulate"])
def test_descriptions_have_no_ragged_lines(command: str) -> None:
    """Within a paragraph, a line is only shorter than 80 columns where the next word does not fit."""
    described = help_of(command).partition("╭")[0].splitlines()
    for line, following in pairwise(map(str.strip, described)):
        if line and following and not line.startswith("Usage"):
            assert len(line) + 1 + len(following.split()[0]) > 78, line


def test_help_of_calibrate_has_everyday_options_first_and_tuning_last() -> None:
    panels = re.findall("^╭─ (.*?) ─", help_of("calibrate"), re.MULTILINE)
    assert panels == ["Arguments", "Everyday", "Prior poses, earlier results", "Tuning"]
    everyday = help_of("calibrate").partition("─ Everyday ")[2].partition("╰")[0]
    assert re.findall("--[a-z]+", everyday) == ["--out", "--force", "--strict", "--json", "--verbose", "--help"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("calgraph cal", ["calibrate"]),
        ("calgraph simulate ", ["rig", "drive", "network"]),
        ("calgraph calibrate --estimator p", ["published"]),
        ("calgraph calibrate --forc", ["--force"]),
        ("calgraph calibrate --set captures.min_h", ["captures.min_hold="]),
        ("calgraph export --format ", ["launch", "tf", "urdf", "kalibr", "camera_info", "corrections", "json"]),
    ],
)
def test_shells_complete_commands_options_and_choices(typed: str, offered: list[str]) -> None:
    words = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" ")), "_CALGRAPH_COMPLETE": "complete_bash"}
    done = subprocess.run(
        [Path(sys.executable).parent / "calgraph"],
        env={**os.environ, **words}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout.split() == offered


def test_the_module_runs_where_the_command_is_not_on_the_path() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "calgraph", "--help"], capture_output=True, text=True, timeout=60, check=True
    )
    assert "calibrate" in done.stdout


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


@pytest.mark.parametrize("command", ["calibrate", "solve"])
def test_help_of_long_commands_waits_for_no_calculation(command: str) -> None:
    """It takes a quarter of a second; models of settings would take as long again, wings a second."""
    code = f"import sys; from calgraph.cli.app import app; app([{command!r}, '--help'], standalone_mode=False)\n"
    heavy = "print(*sys.modules, file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code + heavy], capture_output=True, text=True, timeout=60, check=True
    )
    assert "--estimator" in done.stdout
    slow = ("calgraph.rig", "calgraph.network", "calgraph.recording", "calgraph.config", "scipy", "numpy", "cv2")
    assert [name for name in done.stderr.split() if f"{name}.".startswith(tuple(f"{one}." for one in slow))] == []


def test_calibrate_has_few_parameters_and_hides_former_options() -> None:
    options = re.findall(r"^│[ *]*(--[a-z-]+)", help_of("calibrate"), re.MULTILINE)
    assert len({*options} - {"--help", "--verbose"}) == 17
    assert {"--average", "--feature", "--filter", "--icp", "--start", "--tags", "--weights"} & {*options} == set()


@pytest.mark.parametrize(
    ("error", "code"), [(CalibrationError("why"), 1), (InputError("why"), 2), (RecordingError("why"), 2)]
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


_INTERRUPTED_IMPORT = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # those of nohup ignore it
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            os.kill(os.getpid(), signal.{name})
sys.meta_path.insert(0, Interrupting())
from calgraph.cli import main
main()
"""


@pytest.mark.parametrize("module", ["typer", "calgraph.cli.board"])
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_modules_are_loaded_ends_it_quietly(module: str, by: signal.Signals) -> None:
    code = _INTERRUPTED_IMPORT.replace("{module}", module).replace("{name}", by.name)
    done = subprocess.run(
        [sys.executable, "-c", code, "board"], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (128 + by, "", "")


def run_main(*arguments: str, before: str = "") -> tuple[int, str]:
    """Exit code and standard error of the program."""
    done = subprocess.run(
        [sys.executable, "-c", f"{before}\nfrom calgraph.cli import main; main()", *arguments],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("arguments", "place"), [(["inspect", ""], "an argument"), (["calibrate", "--jobs", ""], "--jobs")]
)
def test_an_empty_argument_is_refused_instead_of_taken_for_this_folder(arguments: list[str], place: str) -> None:
    message = f"calgraph: {place}: is empty, perhaps an unset variable; give a path or a value\n"
    assert run_main(*arguments) == (2, message)


def test_a_name_between_colons_is_printed_as_it_is() -> None:
    assert run_main("inspect", "a:b:c") == (2, "calgraph: a:b:c: does not exist; check the path\n")


@pytest.mark.skipif(sys.platform != "linux", reason="limits of the address space are those of Linux")
def test_a_limit_of_memory_in_which_libraries_do_not_fit_is_one_line() -> None:
    before = "import resource; resource.setrlimit(resource.RLIMIT_AS, (600 * 10**6, 600 * 10**6))"
    message = "calgraph: memory is limited to 600 MB (ulimit -v); at least 1000 MB are needed\n"
    assert run_main("inspect", "recording", before=before) == (1, message)


@pytest.mark.parametrize("error", ["MemoryError", "ImportError('x.so: failed to map segment from shared object')"])
def test_memory_that_runs_out_is_one_line(error: str) -> None:
    code = (
        "import calgraph.cli.app as module\n"
        f"def fail(): raise {error}\n"
        "module.app = fail\n"
        "module.run_command_line()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert done.stderr == "calgraph: memory ran out; reduce --jobs, or give a shorter recording\n"

"""Standard output that is closed, full, or of a terminal that has ASCII only."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

_RUN = f"{shlex.quote(sys.executable)} -c 'from calgraph.cli import main; main()'"
_ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii:strict"}


def run_in_shell(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", f"{_RUN} {command}"],
        env={**os.environ, **environment}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("options", ["--json", ""])
def test_a_full_device_is_named_with_exit_code_2(calibrated: tuple[Path, object], options: str) -> None:
    done = run_in_shell(f"inspect {options} {shlex.quote(str(calibrated[0]))} > /dev/full")
    assert done.stderr == "calgraph: standard output: cannot be written (No space left on device)\n"
    assert done.returncode == 2


def test_help_on_a_full_device_has_no_traceback() -> None:
    done = run_in_shell("--help > /dev/full")
    assert done.stderr == "calgraph: standard output: cannot be written (No space left on device)\n"
    assert done.returncode == 2


def test_an_error_keeps_its_exit_code_where_stderr_is_full() -> None:
    assert run_in_shell("inspect nothing_is_here 2> /dev/full").returncode == 2


@pytest.fixture(scope="module")
def drafted(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rig.yaml that ``init`` writes with all streams open."""
    path = tmp_path_factory.mktemp("drafted") / "rig.yaml"
    done = run_in_shell(f"init {shlex.quote(str(simulated / 'recording'))} -o {shlex.quote(str(path))}")
    assert done.returncode == 0
    return path


@pytest.mark.parametrize("streams", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_no_result(simulated: Path, drafted: Path, tmp_path: Path, streams: str) -> None:
    written, recording = tmp_path / "rig.yaml", shlex.quote(str(simulated / "recording"))
    assert run_in_shell(f"init {recording} -o {shlex.quote(str(written))} {streams}").returncode == 0
    assert written.read_bytes() == drafted.read_bytes()


def test_ascii_terminals_have_signs_in_ascii(calibrated: tuple[Path, object]) -> None:
    done = run_in_shell(f"inspect {shlex.quote(str(calibrated[0]))}", **_ASCII)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.isascii()
    assert "(sigma: along and about its worst axis)" in done.stdout


def test_json_does_not_depend_on_the_terminal(calibrated: tuple[Path, object]) -> None:
    command = f"inspect --json {shlex.quote(str(calibrated[0]))}"
    done = run_in_shell(command, **_ASCII)
    assert json.loads(done.stdout) == json.loads(run_in_shell(command).stdout)


def test_a_file_that_fails_is_not_taken_for_standard_output() -> None:
    code = (
        "import calgraph.cli.app as module; module.app = lambda: open('/nothing/here'); module.run_command_line()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "calgraph: /nothing/here: cannot be used (No such file or directory)\n"

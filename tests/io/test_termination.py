"""The end of a program by a signal."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

_START = """
import os, signal, sys, time
from calgraph.io.termination import add_cleanup, allow_interrupts, handle_signals, remove_cleanup
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)  # background jobs of shells ignore SIGINT
"""
_STOP = "os.kill(os.getpid(), signal.{})"
_WAIT = "time.sleep(600)"


def run(*lines: str, cwd: Path | None = None) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a program."""
    code = "\n".join([_START, *lines])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_the_exit_code_is_that_of_shells(name: str) -> None:
    assert run("handle_signals()", _STOP.format(name), _WAIT) == (128 + getattr(signal, name), "", "")


def test_a_signal_while_an_object_is_deleted_is_not_lost() -> None:
    """Exceptions are discarded there."""
    deleted = f"class Deleted:\n    def __del__(self):\n        {_STOP.format('SIGTERM')}\nDeleted()"
    assert run("handle_signals()", deleted, _WAIT) == (143, "", "")


def test_a_signal_in_an_import_that_catches_everything_is_not_lost() -> None:
    caught = f"try:\n    {_STOP.format('SIGINT')}\nexcept:\n    pass"
    assert run("handle_signals()", caught, _WAIT) == (130, "", "")


def test_cleanups_run_last_first_and_those_removed_do_not() -> None:
    cleanups = (
        "for name in 'abc':\n"
        "    add_cleanup(name, lambda name=name: os.write(1, name.encode()))\n"
        "remove_cleanup('b')"
    )
    assert run("handle_signals()", cleanups, _STOP.format("SIGTERM")) == (143, "ca", "")


def test_a_cleanup_that_fails_keeps_no_other_from_its_work() -> None:
    cleanups = "add_cleanup(1, lambda: os.write(1, b'done'))\nadd_cleanup(2, lambda: 1 / 0)"
    assert run("handle_signals()", cleanups, _STOP.format("SIGTERM")) == (143, "done", "")


def test_a_second_signal_does_not_interrupt_cleanups() -> None:
    again = f"add_cleanup(1, lambda: os.write(1, b'done'))\nadd_cleanup(2, lambda: {_STOP.format('SIGTERM')})"
    assert run("handle_signals()", again, _STOP.format("SIGINT")) == (130, "done", "")


def test_a_cleanup_that_waits_for_ever_ends_with_the_program() -> None:
    waiting = f"import calgraph.io.termination as m\nm._MAX_CLEANUP_TIME = 0.1\nadd_cleanup(1, lambda: {_WAIT})"
    assert run("handle_signals()", waiting, _STOP.format("SIGINT"))[0] == -signal.SIGALRM


def test_signals_that_are_ignored_remain_so() -> None:
    """As by nohup."""
    ignored = "signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    assert run(ignored, "handle_signals()", _STOP.format("SIGHUP"), "print('done')") == (0, "done\n", "")


def test_ctrl_c_raises_an_exception_again_where_it_is_the_regular_end() -> None:
    caught = f"try:\n    {_STOP.format('SIGINT')}\nexcept KeyboardInterrupt:\n    print('ended')"
    assert run("handle_signals()", "allow_interrupts()", caught) == (0, "ended\n", "")


_WRITE = {
    "file": "with write_atomically(Path('out.txt')) as file:\n    file.write_text('new')",
    "folder": "with replace_folder_atomically(Path('out'), 'a') as folder:\n"
    "    for name in 'abc':\n        (folder / name).write_text('new')",
    "temporary folder": "with temporary_folder() as folder:\n    (folder / 'a').write_text('new')",
    "recording": "with RecordingWriter(Path('out')) as writer:\n"
    "    writer.write('/scan', LaserScan(1.0, 'laser', np.arange(9.0), np.ones(9)))",
}
_STOP_AT_EVERY_OPERATION = """
import numpy as np
from pathlib import Path
from calgraph.io.atomic import replace_folder_atomically, temporary_folder, write_atomically
from calgraph.recording import RecordingWriter
from calgraph.sensors import LaserScan
def write():
    {write}
def is_operation(event, arguments):
    if event == "open":
        return isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    return event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")
for number in range(1, 1000):
    child = os.fork()
    if child == 0:
        handle_signals()
        count = 0
        def stop(event, arguments):
            global count
            if is_operation(event, arguments):
                count += 1
                if count == number:
                    os.kill(os.getpid(), signal.SIGTERM)
        sys.addaudithook(stop)
        write()
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = [str(file) for file in Path().rglob("*") if file.name.endswith(".tmp")]
    if code == 0 or left:
        print(code, left, number > 1)
        break
    assert code == 143, code
    os.system("rm -rf out out.txt")
"""


@pytest.mark.parametrize("what", list(_WRITE))
def test_a_signal_at_any_operation_on_files_leaves_none(what: str, tmp_path: Path) -> None:
    write = _WRITE[what].replace("\n", "\n    ")
    code = f"os.environ['TMPDIR'] = {str(tmp_path)!r}"
    assert run(code, _STOP_AT_EVERY_OPERATION.replace("{write}", write), cwd=tmp_path) == (0, "0 [] True\n", "")

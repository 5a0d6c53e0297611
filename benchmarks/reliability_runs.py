"""Runs of the installed command line, as a user starts it, with a limit of time and a search for what is left."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

MAX_SECONDS = 120.0
"""A run that takes longer has failed. The small recordings here take 3 s on an idle core."""
MAX_BYTES = 2**30
"""Largest resident set of one process of a run."""
_LONGEST_END = 20.0
"""Processes that a run has started must have ended this long after it, s; a loaded machine needs a few."""


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    code: int
    """Exit code; negative is the signal that ended it."""
    stdout: str
    stderr: str
    seconds: float
    peak: int
    """Largest resident set of one of its processes, bytes."""
    hung: bool
    """Whether it was ended by the limit of time."""
    orphans: int
    """Processes that it started and that did not end after it."""


def find_command() -> Sequence[str]:
    """The installed program, beside this interpreter or on the path."""
    beside = Path(sys.executable).with_name("calgraph")
    found = str(beside) if beside.is_file() else shutil.which("calgraph")
    if found is None:
        sys.exit("calgraph is not installed in this environment")
    return [found]


def run(
    arguments: Sequence[object],
    cwd: Path,
    *,
    prefix: Sequence[str] = (),
    program: Sequence[str] | None = None,
    environment: Mapping[str, str | None] | None = None,
    disturb: Callable[[subprocess.Popen[bytes]], None] | None = None,
    streams: str = "",
) -> Ending:
    """Runs one command to its end.

    Args:
        arguments: of calgraph.
        cwd: folder in which it runs.
        prefix: a program that starts it with other limits or file systems, such as prlimit.
        program: instead of the installed one.
        environment: variables that differ; None removes one.
        disturb: called with the running process by another thread.
        streams: redirections of a shell, such as ``>&-``; standard output and error are kept otherwise.
    """
    command = [*prefix, *(program or find_command()), *map(str, arguments)]
    if streams:
        command = ["sh", "-c", f'exec "$@" {streams}', "sh", *command]
    # Each case has a separate cache of detections, which a next run in the same folder uses.
    changed = {**os.environ, "CALGRAPH_CACHE": str(cwd / "cache"), **(environment or {})}
    variables = {name: value for name, value in changed.items() if value is not None}
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        began = time.monotonic()
        process = subprocess.Popen(
            command, cwd=cwd, env=variables, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr,
            start_new_session=True,
        )  # fmt: skip
        late = threading.Timer(MAX_SECONDS, _kill_session, [process.pid])
        late.start()
        disturber = threading.Thread(target=disturb, args=[process]) if disturb else None
        if disturber:
            disturber.start()
        # wait4 returns the usage of this one process; that of all children would mix the runs.
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.monotonic() - began
        late.cancel()
        if disturber:
            disturber.join()
        orphans = _count_orphans(process.pid)
        written = _read_back(stdout), _read_back(stderr)
    unit = 1 if sys.platform == "darwin" else 1024
    peak, hung = usage.ru_maxrss * unit, seconds >= MAX_SECONDS
    return Ending(process.returncode, written[0], written[1], seconds, peak, hung, orphans)


def _read_back(stream: IO[bytes]) -> str:
    stream.seek(0)
    return stream.read().decode(errors="replace")


def processes_of_session(session: int) -> list[int]:
    """The processes of a session, its first one included, without those that have ended and are not reaped."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            # State, parent, group and session follow the name, which is in parentheses and may contain anything.
            fields = (entry / "stat").read_text(errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] not in "ZX":
            found.append(int(entry.name))
    return found


def _count_orphans(session: int) -> int:
    """Processes that do not end in time; they are killed then."""
    end = time.monotonic() + _LONGEST_END
    while (left := processes_of_session(session)) and time.monotonic() < end:
        time.sleep(0.02)
    while processes_of_session(session):
        _kill_session(session)
        time.sleep(0.02)
    return len(left)


def _kill_session(session: int) -> None:
    for pid in processes_of_session(session):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue

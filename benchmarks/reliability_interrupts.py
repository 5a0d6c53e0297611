"""Attempts with signals: SIGKILL, SIGTERM and SIGINT at random times, and before each operation on files."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, find_left, judge_ending
from reliability_cases import Case
from reliability_lines import link_documents
from reliability_runs import Ending, processes_of_session, run

TABLE, SWEEP_TABLE = "signals", "SIGKILL before each operation on files"
NOTHING, EARLIER, NEW, MIXED = "no result", "earlier result", "new result", "mixed"
"""States of what a command writes."""
NOT_HIT = "ended before"
_MARKERS = "calibration.yaml", "recording", "intrinsics.json"
"""A folder without them holds no result."""
_CALIBRATE = "calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0"
_SIGNALS = {
    "SIGKILL": signal.SIGKILL,
    "SIGTERM": signal.SIGTERM,
    "SIGINT (Ctrl-C)": signal.SIGINT,
    "SIGHUP (terminal closed)": signal.SIGHUP,
}
_TWICE = "SIGINT, and SIGTERM soon after"
_WORKER = "SIGKILL of one worker"
KINDS = *_SIGNALS, _TWICE, _WORKER
_CODES: Mapping[str, tuple[int, ...]] = {
    # Negative where the signal comes before the first line of calgraph, or after its last.
    **{kind: (-number, 128 + number) for kind, number in _SIGNALS.items()},
    "SIGKILL": (-9,),
    _TWICE: (-2, 130, -15, 143),
    _WORKER: (1,),
}
_LONGEST_END = 5.0
"""A run must have ended this long after a signal, s."""
_COUNT_OPERATIONS = """
import atexit, os, signal, sys
kill_at, folder, main, count = int(sys.argv.pop(1)), os.getcwd() + os.sep, os.getpid(), 0
def hook(event, arguments):
    global count
    if event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "open") and arguments:
        writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & writes):
            return
        if isinstance(arguments[0], (str, bytes, os.PathLike)) and os.getpid() == main:
            if os.path.abspath(os.fsdecode(arguments[0])).startswith(folder):
                count += 1
                if count == kill_at:
                    os.kill(main, signal.SIGKILL)
sys.addaudithook(hook)
atexit.register(lambda: print("operations:", count, file=sys.stderr) if os.getpid() == main else None)
from calgraph.cli import main as command_line
command_line()
"""
"""A program that kills itself before one of its operations on files below its folder."""


_LAST_OPERATIONS = 5
"""Of commands that take long, operations before these are left out."""


@dataclass(frozen=True)
class Task:
    """A command that writes something."""

    name: str
    command: Sequence[str]
    output: str
    """What it writes, a file or folder."""
    prepare: Sequence[Sequence[str]] = ()
    """Commands before it, which write an earlier result."""
    again: Sequence[str] = ("--force",)
    """Options of the next run over a result."""
    refused_over_new: bool = False
    """Whether the next run refuses to replace a complete result."""
    workers: bool = False
    heavy: bool = False
    """Whether it takes so long that fewer signals are sent."""


TASKS: Sequence[Task] = (
    Task("calibrate", (*_CALIBRATE, "--jobs", "1"), "out"),
    Task("calibrate, 3 processes", (*_CALIBRATE, "--jobs", "3"), "out", workers=True),
    Task(
        "calibrate --force, 3 processes",
        (*_CALIBRATE, "--jobs", "3", "--force"),
        "out",
        ((*_CALIBRATE, "--estimator", "hypergraph"),),
        (),
        workers=True,
    ),
    Task("solve --force", ("solve", "problem.npz", "-o", "out", "--folds", "0", "--force"), "out",
         (("solve", "problem.npz", "-o", "out", "--estimator", "hypergraph"),), ()),
    Task("check -o", ("check", "rig.yaml", "recording", "--against", "extrinsics.yaml", "-o", "out"), "out"),
    Task("simulate", ("simulate", "rig", "--scenario", "scenario.yaml", "-o", "robot"), "robot", again=(),
         refused_over_new=True),
    Task("intrinsics, 3 processes", ("intrinsics", "rig.yaml", "recording", "-o", "out", "--jobs", "3"), "out",
         workers=True),
    Task("demo", ("demo", "--out", "demo"), "demo", again=("--force",), heavy=True),
    Task("init --force", ("init", "recording", "-o", "draft.yaml", "--force"), "draft.yaml",
         (("export", "calibration.yaml", "-f", "tf", "--force", "-o", "draft.yaml"),), ()),
    Task("export -o", ("export", "calibration.yaml", "-f", "urdf", "--force", "-o", "new.urdf"), "new.urdf",
         again=()),
)  # fmt: skip


@dataclass
class References:
    """What each task writes undisturbed, and how long it takes; measured once."""

    whole: Path
    """The documents."""
    states: dict[str, tuple[Mapping[str, str], Mapping[str, str], float]] = field(default_factory=dict)
    """Earlier and new result, and s, by task."""

    def measure(self, scratch: Path) -> "References":
        """Runs every task once."""
        for number, task in enumerate(TASKS):
            folder = scratch / f"reference {number}"
            folder.mkdir(parents=True)
            link_documents(self.whole, folder)
            earlier = self.prepare(task, folder)
            ending = run(task.command, folder)
            if ending.code:
                sys.exit(f"{task.name} fails undisturbed: {ending.stderr}")
            self.states[task.name] = earlier, fingerprint(folder / task.output), ending.seconds
            shutil.rmtree(folder)
        return self

    def prepare(self, task: Task, folder: Path) -> Mapping[str, str]:
        """Makes the earlier result, and its content."""
        kept = self.whole.parent / f"earlier {TASKS.index(task)}"
        if not kept.exists():
            for command in task.prepare:
                run(command, folder)
            if task.prepare:
                (folder / task.output).rename(kept)
        if task.prepare:
            shutil.copytree(kept, folder / task.output) if kept.is_dir() else shutil.copy(
                kept, folder / task.output
            )
        return fingerprint(folder / task.output)


def fingerprint(path: Path) -> Mapping[str, str]:
    """The content of a result by file, without dates; empty if there is none."""
    files = [path] if path.is_file() else sorted(one for one in path.rglob("*") if one.is_file())
    whole = [file for file in files if not any(part.endswith(".tmp") for part in file.relative_to(path).parts)]
    return {str(file.relative_to(path)): _hash(file) for file in whole}


def _hash(file: Path) -> str:
    data = file.read_bytes()
    if file.name == "calibration.yaml":
        data = data.partition(b"\nprovenance:")[0]
    if file.name == "report.html":
        data = data.rstrip()[-7:]
    return hashlib.sha256(data).hexdigest()


def list_cases(references: References, seeds: int) -> Iterator[Case]:
    """Signals at random times."""
    for seed in range(12 * seeds):
        for kind in KINDS:
            for task in TASKS:
                if (task.workers or kind != _WORKER) and not (task.heavy and seed % 6):
                    yield Case(TABLE, kind, task.name, seed, partial(_attempt_signal, references, task, kind))


def list_operations(references: References, scratch: Path) -> Iterator[Case]:
    """SIGKILL before the first operation on files, the second, and so on to the last."""
    for task in TASKS:
        folder = scratch / f"count {TASKS.index(task)}"
        folder.mkdir(parents=True)
        link_documents(references.whole, folder)
        references.prepare(task, folder)
        counted = run(task.command, folder, program=[sys.executable, "-c", _COUNT_OPERATIONS, "0"])
        shutil.rmtree(folder)
        last = int(counted.stderr.split()[-1])
        for number in range(last - _LAST_OPERATIONS if task.heavy else 1, last + 1):
            yield Case(
                SWEEP_TABLE, SWEEP_TABLE, task.name, number, partial(_attempt_operation, references, task, number)
            )


def _attempt_signal(
    references: References, task: Task, kind: str, folder: Path, rng: np.random.Generator
) -> Judged:
    duration = references.states[task.name][2]
    # The second half of the times is among the last 40 %, where results are written.
    delay = duration * (rng.uniform(0, 1) if rng.random() < 0.5 else rng.uniform(0.6, 1.1))
    disturb = partial(_kill_worker if kind == _WORKER else _send, delay, kind)
    return _judge(references, task, kind, folder, lambda: run(task.command, folder, disturb=disturb), delay)


def _attempt_operation(
    references: References, task: Task, number: int, folder: Path, _rng: np.random.Generator
) -> Judged:
    program = [sys.executable, "-c", _COUNT_OPERATIONS, str(number)]
    return _judge(references, task, "SIGKILL", folder, lambda: run(task.command, folder, program=program))


def _send(delay: float, kind: str, process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    number = _SIGNALS.get(kind, signal.SIGINT)
    # A terminal sends its signals to all processes of a command.
    send = os.killpg if number in (signal.SIGINT, signal.SIGHUP) else os.kill
    with suppress(ProcessLookupError):
        if process.returncode is None:
            send(process.pid, number)
        if kind == _TWICE:
            time.sleep(delay % 0.05)
            send(process.pid, signal.SIGTERM)


def _kill_worker(delay: float, _kind: str, process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    workers = [pid for pid in processes_of_session(process.pid) if pid != process.pid]
    if workers:
        os.kill(workers[int(1000 * delay) % len(workers)], signal.SIGKILL)


def _judge(
    references: References, task: Task, kind: str, folder: Path, start: Callable[[], Ending], delay: float = 0.0
) -> Judged:
    link_documents(references.whole, folder)
    earlier, new, _ = references.states[task.name]
    references.prepare(task, folder)
    ending = start()
    names = ["a process was killed", "killed"]
    if (found := judge_ending(ending, names, (0, *_CODES[kind]))) and found.answer.is_wrong:
        return found
    state = state_of(folder / task.output, earlier, new)
    if state == MIXED:
        return Judged(Answer.HALF, f"{ending.code}: {sorted(fingerprint(folder / task.output))}")
    if ending.code == 0 and state != NEW:
        return Judged(Answer.HALF, f"exit code 0 and {state}")
    if kind != "SIGKILL" and (left := find_left(folder)):
        return Judged(Answer.LEFT, left[0])
    if kind not in ("SIGKILL", _WORKER):
        late = ending.seconds - delay
        if ending.code != 0 and late > _LONGEST_END:
            return Judged(Answer.HANG, f"ended {late:.1f} s after the signal")
        # Nothing is left to be removed, and what a next run finds is what this one found.
        return Judged(Answer.RIGHT, NOT_HIT if ending.code == 0 else state)
    again = run([*task.command, *(task.again if state == NEW else ())], folder)
    refused = task.refused_over_new and state == NEW
    if again.code != (2 if refused else 0):
        return Judged(Answer.CRASH, f"the next run failed: {again.stderr[-300:]}")
    if state_of(folder / task.output, earlier, new) != NEW:
        return Judged(Answer.HALF, "the next run wrote something else")
    if left := find_left(folder):
        return Judged(Answer.LEFT, f"after the next run: {left[0]}")
    return Judged(Answer.RIGHT, NOT_HIT if ending.code == 0 else state)


def state_of(output: Path, earlier: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Which result is there."""
    now = fingerprint(output)
    if now == new:
        return NEW
    if not now or not (output.is_file() or any((output / name).exists() for name in _MARKERS)):
        return NOTHING
    return EARLIER if now == earlier else MIXED

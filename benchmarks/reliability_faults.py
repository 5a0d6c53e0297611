"""Attempts with faults of the computer: disks full or read-only, no shared memory, limits of memory and files.

File systems are mounted in a namespace of the run alone, which needs Linux and the right to make one; elsewhere
these cases are left out.
"""

import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, find_left, judge_ending
from reliability_bags import Source
from reliability_cases import Case
from reliability_recordings import judge_output
from reliability_runs import run
from reliability_tasks import EARLIER, NEW, NOTHING, TASKS, References, Task, fingerprint, link_documents, state_of

TABLE = "faults"
NOT_POSSIBLE = "not possible here"
_NAMES = (
    "No space", "Read-only", "File too large", "cannot be written", "memory", "Too many open files", "processes",
    "shared memory", "a process was killed", "cannot be used",
)  # fmt: skip
_DISK_SIZES = "16k", "128k", "512k", "1m", "2m", "4m"
_FILE_SIZES = 1000, 20_000, 200_000, 1_000_000
_MEMORY = 300, 500, 700, 900, 1200, 2000
"""Address space of each process, MB."""
_DESCRIPTORS = 12, 16, 20, 24, 32, 64
TASK_NAMES = (
    "calibrate", "calibrate, 3 processes", "calibrate --force, 3 processes", "simulate", "init --force",
    "export -o",
)  # fmt: skip
_FULL = "head -c 4096 /dev/zero > /dev/shm/x"
_READ_ONLY = "mount --bind {0} {0} && mount -o remount,bind,ro {0}"


@dataclass(frozen=True)
class Fault:
    """How a command is started."""

    script: str = ""
    """Commands of a shell in a namespace with its own mounts, before the command."""
    prefix: tuple[str, ...] = ()
    environment: tuple[tuple[str, str | None], ...] = ()


FAULTS: Mapping[str, Sequence[Fault]] = {
    "disk of OUT full": [Fault(f"mount -t tmpfs -o size={size} tmpfs disk") for size in _DISK_SIZES],
    "files of limited size": [Fault(prefix=("prlimit", f"--fsize={size}")) for size in _FILE_SIZES],
    "folder of OUT read-only": [Fault(_READ_ONLY.format("disk"))],
    "cache, home and temporary folder read-only": [
        Fault(
            f"{_READ_ONLY.format('cache')} && {_READ_ONLY.format('home')}",
            environment=(("HOME", "{folder}/home"), ("TMPDIR", "{folder}/home")),
        )
    ],
    "disk of the cache full": [Fault("mount -t tmpfs -o size=8k tmpfs cache")],
    "shared memory read-only": [Fault("mount -t tmpfs -o ro tmpfs /dev/shm")],
    "shared memory full": [Fault(f"mount -t tmpfs -o size=4k tmpfs /dev/shm && {_FULL}")],
    "no /proc": [Fault("mount -t tmpfs tmpfs /proc")],
    "limit of memory": [Fault(prefix=("prlimit", f"--as={size}000000")) for size in _MEMORY],
    "limit of open files": [Fault(prefix=("prlimit", f"--nofile={count}")) for count in _DESCRIPTORS],
    "one processor": [Fault(prefix=("taskset", "-c", "0"))],
    "no HOME, no PATH": [Fault(environment=(("HOME", None), ("PATH", None), ("USER", None)))],
    "folders of the environment missing": [
        Fault(environment=(("HOME", "/nothing"), ("TMPDIR", "/nothing"), ("XDG_CACHE_HOME", "/nothing")))
    ],
    "locale not UTF-8": [
        Fault(environment=(("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0"))),
        Fault(environment=(("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONIOENCODING", "ascii:strict"))),
    ],
    "a terminal of odd size": [Fault(environment=(("COLUMNS", "3"), ("LINES", "0"), ("TERM", "unknown")))],
}


def list_cases(source: Source, references: References) -> Iterator[Case]:
    """Every fault with every command that writes something."""
    for kind, faults in FAULTS.items():
        for task in TASKS:
            if task.name in TASK_NAMES:
                for number, fault in enumerate(faults):
                    yield Case(TABLE, kind, task.name, number, partial(_attempt, source, references, task, fault))


@cache
def can_mount() -> bool:
    """Whether a run can have its own mounts here."""
    if shutil.which("unshare") is None:
        return False
    return subprocess.run(["unshare", "-rm", "true"], check=False, capture_output=True).returncode == 0


def _attempt(
    source: Source, references: References, task: Task, fault: Fault, folder: Path, _rng: np.random.Generator
) -> Judged:
    if fault.script and not can_mount():
        return Judged(Answer.RIGHT, NOT_POSSIBLE)
    link_documents(references.whole, folder)
    for name in ("cache", "home", "disk"):
        (folder / name).mkdir()
    earlier, new, _ = references.states[task.name]
    on_disk = "disk" in fault.script
    output = f"disk/{task.output}" if on_disk and not task.prepare else task.output
    references.prepare(task, folder)
    command = [output if part == task.output else part for part in task.command]
    prefix: Sequence[str] = fault.prefix
    if fault.script:
        # What is on a disk of the namespace is copied before that ends.
        keep = '"$@"; code=$?; cp -r disk kept; exit $code'
        prefix = ["unshare", "-rm", "sh", "-c", f"({fault.script}) || exit 99; {keep}", "sh"]
    environment = {name: value and value.format(folder=folder) for name, value in fault.environment}
    ending = run(command, folder, prefix=prefix, environment=environment)
    if ending.code == 99:
        return Judged(Answer.RIGHT, NOT_POSSIBLE)
    found = judge_ending(ending, _NAMES)
    if found and found.answer.is_wrong:
        return found
    place = folder / "kept" if on_disk and output != task.output else folder
    state = state_of(place / task.output, earlier, new)
    if state not in ((NEW,) if ending.code == 0 else (NOTHING, EARLIER, NEW)):
        return Judged(Answer.HALF, f"exit code {ending.code}: {state}: {sorted(fingerprint(place / task.output))}")
    if left := find_left(folder, place):
        return Judged(Answer.LEFT, left[0])
    return found or judge_output(source, None, "", folder)

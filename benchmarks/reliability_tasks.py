"""Commands that write something, what they write undisturbed, and which result is there afterwards."""

import hashlib
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from reliability_bags import Source, write_rig
from reliability_runs import run

NOTHING, EARLIER, NEW, MIXED = "no result", "earlier result", "new result", "mixed"
"""States of what a command writes."""
_MARKERS = "calibration.yaml", "recording", "intrinsics.json"
"""A folder without them holds no result."""
_CALIBRATE = "calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0"


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


def write_documents(source: Source, folder: Path) -> None:
    """The files that commands read, made from the recording by calgraph."""
    folder.mkdir()
    (folder / "recording").symlink_to(source.folder / "recording")
    write_rig(folder / "rig.yaml", source.rig)
    shutil.copy(source.folder / "scenario.yaml", folder)
    run([*_CALIBRATE, "--jobs", "1", "--dump", "problem.npz"], folder)
    for place in (folder / "calibration.yaml", folder / "extrinsics.yaml", source.folder / "extrinsics.yaml"):
        shutil.copy(folder / "out" / "calibration.yaml", place)
    # Attempts start with an empty cache.
    for left in ("out", "cache"):
        shutil.rmtree(folder / left)


def link_documents(whole: Path, folder: Path) -> None:
    """The documents in a separate folder."""
    for entry in whole.iterdir():
        (folder / entry.name).symlink_to(entry)


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


def state_of(output: Path, earlier: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Which result is there."""
    now = fingerprint(output)
    if now == new:
        return NEW
    if not now or not (output.is_file() or any((output / name).exists() for name in _MARKERS)):
        return NOTHING
    return EARLIER if now == earlier else MIXED

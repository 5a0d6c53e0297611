"""Attempts with damaged documents: rig.yaml, and the files that other commands read."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Judged, judge_ending
from reliability_bags import Source, write_rig
from reliability_bytes import FILE_DAMAGE
from reliability_cases import Case
from reliability_mutations import NPZ_MUTATIONS, TEXT_MUTATIONS, YAML_MUTATIONS, Mutate
from reliability_recordings import judge_output
from reliability_runs import run

RIG_TABLE, FILE_TABLE = "rig.yaml", "files of other commands"
_BYTES = "cut off anywhere", "1 to 10,000 bytes changed", "files of 0 bytes", "Git LFS pointers", "something else"
_CALIBRATE = ("calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0", "--jobs", "1")
_FORMATS = "launch", "tf", "urdf", "kalibr", "json"


@dataclass(frozen=True)
class Document:
    """A file that a command reads."""

    name: str
    mutations: Mapping[str, Mutate]
    commands: Sequence[Sequence[str]]
    """Of which one is run, by seed."""


_SOLVE = ("solve", "problem.npz", "-o", "out", "--folds", "0")
DOCUMENTS: Sequence[Document] = (
    Document(
        "calibration.yaml",
        YAML_MUTATIONS,
        (
            *(("export", "calibration.yaml", "--format", name, "--force") for name in _FORMATS),
            ("check", "rig.yaml", "problem.npz", "--against", "calibration.yaml"),
            ("inspect", "."),
            (*_SOLVE, "--prior", "calibration.yaml"),
        ),
    ),
    Document(
        "problem.npz",
        NPZ_MUTATIONS,
        (
            _SOLVE,
            ("check", "rig.yaml", "problem.npz", "--against", "extrinsics.yaml"),
            ("verify", "problem.npz", "--rounds", "20"),
        ),
    ),
    Document(
        "robot.urdf",
        TEXT_MUTATIONS,
        (
            ("check", "rig.yaml", "problem.npz", "--against", "robot.urdf"),
            ("export", "calibration.yaml", "--format", "urdf", "--urdf", "robot.urdf", "--force"),
        ),
    ),
    Document("tf.yaml", YAML_MUTATIONS, (("check", "rig.yaml", "problem.npz", "--against", "tf.yaml"),)),
    Document(
        "rig.resolved.yaml", YAML_MUTATIONS, (("export", "calibration.yaml", "--format", "kalibr", "--force"),)
    ),
    Document(
        "scenario.yaml", YAML_MUTATIONS, (("simulate", "rig", "--scenario", "scenario.yaml", "-o", "simulated"),)
    ),
    Document("board.yaml", YAML_MUTATIONS, (("init", "recording", "-o", "draft.yaml", "--board", "board.yaml"),)),
)
RIGS = "rig.yaml", "rig.resolved.yaml"
FILE_KINDS = tuple(dict.fromkeys([kind for one in DOCUMENTS for kind in one.mutations] + list(_BYTES)))
_MESSAGE_NAMES = (
    "calgraph-", "capture", "sensors", "target", "settings", "root", "tolerance", "board", "camera",
    "lidar", "laser",
)  # fmt: skip


def write_documents(source: Source, folder: Path) -> Path:
    """One of each file, made from the undamaged recording by the commands."""
    folder.mkdir()
    (folder / "recording").symlink_to(source.folder / "recording")
    write_rig(folder / "rig.yaml", source.rig)
    shutil.copy(source.folder / "scenario.yaml", folder)
    run([*_CALIBRATE, "--dump", "problem.npz"], folder)
    for name in ("calibration.yaml", "rig.resolved.yaml"):
        shutil.copy(folder / "out" / name, folder)
    for place in (folder, source.folder):
        shutil.copy(folder / "out" / "calibration.yaml", place / "extrinsics.yaml")
    for suffix in ("urdf", "tf"):
        name = "robot.urdf" if suffix == "urdf" else "tf.yaml"
        run(["export", "calibration.yaml", "--format", suffix, "--force", "-o", name], folder)
    printed = run(["board", "--size", "600x400", "-o", "board.pdf"], folder)
    (folder / "board.yaml").write_text(printed.stdout)
    # Attempts start with an empty cache.
    for left in ("out", "cache"):
        shutil.rmtree(folder / left)
    return folder


def list_rigs(source: Source, whole: Path, seeds: int) -> Iterator[Case]:
    """Mutations of rig.yaml as users write it, and with all settings."""
    for seed in range(6 * seeds):
        for kind in YAML_MUTATIONS:
            for name in RIGS:
                document = Document(name, YAML_MUTATIONS, (_CALIBRATE,))
                yield Case(
                    RIG_TABLE, kind, name, seed, partial(_attempt, source, whole, document, kind, seed, "rig.yaml")
                )


def list_files(source: Source, whole: Path, seeds: int) -> Iterator[Case]:
    """Mutations of the files that other commands read, and damage of their bytes."""
    for seed in range(seeds * 2):
        for document in DOCUMENTS:
            for kind in (*document.mutations, *_BYTES):
                yield Case(
                    FILE_TABLE,
                    kind,
                    document.name,
                    seed,
                    partial(_attempt, source, whole, document, kind, seed, document.name),
                )


def _attempt(
    source: Source,
    whole: Path,
    document: Document,
    kind: str,
    seed: int,
    name: str,
    folder: Path,
    rng: np.random.Generator,
) -> Judged:
    for entry in whole.iterdir():
        (folder / entry.name).symlink_to(entry)
    (folder / name).unlink()
    data = (whole / document.name).read_bytes()
    if kind in document.mutations:
        (folder / name).write_bytes(document.mutations[kind](data, rng))
    else:
        (folder / name).write_bytes(data)
        FILE_DAMAGE[kind](folder / name, rng)
    # Which command reads it depends on the kind as well: each kind meets all of them.
    choice = (seed + [*document.mutations, *_BYTES].index(kind)) % len(document.commands)
    command = document.commands[choice]
    found = judge_ending(run(command, folder), [*_MESSAGE_NAMES, name])
    return judge_output(source, found, command[0], folder)

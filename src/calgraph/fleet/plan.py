"""The work of a fleet: which recordings of which robots, and by what each result is known."""

import glob
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from calgraph.calibration.result_files import hash_input
from calgraph.config import FleetConfig
from calgraph.recording.bag_files import split_numbers
from calgraph.recording.content_hash import hash_text

_FORMAT = "calgraph-fleet-key/1"
_SUFFIXES = {".mcap", ".db3", ".bag", ".zstd", ".mp4", ".avi", ".mkv", ".mov", ".webm"}
"""Of recordings, which the names of their folders lack."""
_MAX_NAME_LENGTH = 200
"""Of a folder; systems allow 255 bytes."""


@dataclass(frozen=True)
class RecordingTask:
    """One recording of one robot, to be calibrated or checked."""

    robot: str
    recording: str
    """Its name, and that of its folder."""
    action: Literal["calibrate", "check"]
    rig: Path
    path: Path
    reference: Path | None
    folder: Path
    """For the results."""
    seed: int
    key: str
    """Hash of the contents of all inputs, of the arguments, and of the version of calgraph."""


@dataclass(frozen=True)
class RobotPlan:
    """The recordings of one robot in the order of time."""

    name: str
    tasks: tuple[RecordingTask, ...] = ()
    problem: str = ""
    """Why it has none."""


def plan_fleet(config: FleetConfig, folder: Path, out: Path, seed: int) -> tuple[RobotPlan, ...]:
    """Lists the work of a fleet.

    Args:
        config: what fleet.yaml states.
        folder: of fleet.yaml, which paths are relative to.
        out: folder for the results of the fleet.
        seed: of random samples.

    Returns:
        Plans in the order of fleet.yaml. Robots whose recordings cannot be found state why.
    """
    hash_once = cache(hash_input)
    # Workers of a cluster have other working directories.
    folder, out = folder.absolute(), out.absolute()
    return tuple(_plan_robot(config, name, folder, out, seed, hash_once) for name in config.robots)


def _plan_robot(
    config: FleetConfig, name: str, folder: Path, out: Path, seed: int, hash_file: Callable[[Path], str]
) -> RobotPlan:
    entry = config.robots[name]
    rig, reference = entry.rig or config.rig, entry.reference or config.reference
    assert rig is not None
    patterns = [pattern.replace("{robot}", name) for pattern in entry.recordings or config.recordings or ()]
    found: list[tuple[Path, str]] = []
    for pattern in patterns:
        matches = list(_find_recordings(folder, pattern, name))
        if not matches:
            return RobotPlan(name, problem=f"no recording matches {pattern}")
        found += matches
    paths = [path for path, _ in found]
    if twice := next((path for path in paths if paths.count(path) > 1), None):
        return RobotPlan(name, problem=f"the recording {twice} is given twice")
    rig_path = folder / rig.replace("{robot}", name)
    reference_path = folder / reference.replace("{robot}", name) if reference else None
    hashes = [hash_file(rig_path), hash_file(reference_path) if reference_path else ""]
    tasks = tuple(
        RecordingTask(
            robot=name,
            recording=recording,
            action=config.action,
            rig=rig_path,
            path=path,
            reference=reference_path,
            folder=out / "robots" / name / recording,
            seed=seed,
            key=hash_text(repr([_FORMAT, version("calgraph"), config.action, seed, *hashes, hash_file(path)])),
        )
        for path, recording in zip(paths, _distinguish([recording for _, recording in found]), strict=True)
    )
    return RobotPlan(name, tasks)


def _find_recordings(folder: Path, pattern: str, robot: str) -> Iterator[tuple[Path, str]]:
    """Path and name of the recording, or of all that match a pattern, sorted with numbers by their value.

    The name is the part of the path that the pattern does not fix, without the name of the robot. It stays when
    further recordings are added later.
    """
    if not glob.has_magic(pattern) or (folder / pattern).exists():
        yield folder / pattern, _name_recording(Path(pattern).parts, robot)
        return
    fixed = next(k for k, part in enumerate(Path(pattern).parts) if glob.has_magic(part))
    for found in sorted(glob.glob(pattern, root_dir=folder, recursive=True), key=split_numbers):  # noqa: PTH207
        yield folder / found, _name_recording(Path(found).parts[fixed:], robot)


def _name_recording(parts: Sequence[str], robot: str) -> str:
    last = Path(parts[-1])
    named = [*parts[:-1], last.stem if last.suffix in _SUFFIXES else last.name]
    name = "_".join(part for part in named if part not in (robot, "..", "/"))
    return re.sub(r"[^\w.-]+", "_", name).lstrip(".")[-_MAX_NAME_LENGTH:] or "recording"


def _distinguish(names: Sequence[str]) -> list[str]:
    """The names, of which the second of two equal ones, in capitals or not, ends with _2."""
    lower = [name.lower() for name in names]
    numbers = [lower[: k + 1].count(name) for k, name in enumerate(lower)]
    return [name if number == 1 else f"{name}_{number}" for name, number in zip(names, numbers, strict=True)]

"""Attempts with recordings of sensors that failed: calibrate, and also inspect, init and check."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, find_left, judge_ending, judge_result
from reliability_bags import FORMS, Source, write_rig
from reliability_cases import Case
from reliability_messages import MESSAGE_DAMAGE
from reliability_runs import run

TABLE = "recordings"
_CALIBRATE = "calibrate", "rig.yaml", "{recording}", "-o", "out", "--folds", "0", "--jobs", "1"
_COMMANDS: Sequence[Sequence[str]] = (
    _CALIBRATE,
    ("inspect", "{recording}"),
    _CALIBRATE,
    ("init", "{recording}", "-o", "draft.yaml"),
    _CALIBRATE,
    ("check", "rig.yaml", "{recording}", "--against", "{extrinsics}", "-o", "out"),
)
"""By seed: half of the attempts calibrate."""
_CODES_OF = {"check": (0, 1, 2)}
_FEW_FILES = 12


def list_cases(source: Source, seeds: int) -> Iterator[Case]:
    """All kinds of damage in all forms."""
    for seed in range(seeds):
        for kind in MESSAGE_DAMAGE:
            for form in FORMS:
                yield Case(TABLE, kind, form, seed, partial(_attempt, source, kind, form, seed))


def _attempt(source: Source, kind: str, form: str, seed: int, folder: Path, rng: np.random.Generator) -> Judged:
    recording = FORMS[form](folder / "recording", MESSAGE_DAMAGE[kind](source.items, rng))
    return judge_recording(source, form, recording, folder, seed)


def judge_recording(source: Source, form: str, recording: Path, folder: Path, seed: int) -> Judged:
    """Runs the command of a seed on a recording, and judges its answer."""
    write_rig(folder / "rig.yaml", source.rig_of(form))
    command = _COMMANDS[seed % len(_COMMANDS)]
    places = {"recording": recording.name, "extrinsics": source.folder / "extrinsics.yaml"}
    ending = run([part.format(**places) for part in command], folder)
    names = [recording.name, *source.rig["sensors"], "capture", "board", *_file_names(recording)]
    found = judge_ending(ending, names, _CODES_OF.get(command[0], (0, 1, 2)))
    return judge_output(source, found, command[0], folder)


def judge_output(source: Source, found: Judged | None, command: str, folder: Path, results: str = "out") -> Judged:
    """The answer where a command ended by itself: what it wrote must be complete, and right if it exits with 0."""
    if found and found.answer.is_wrong:
        return found
    if left := find_left(folder):
        return Judged(Answer.LEFT, left[0])
    out = folder / results
    if out.exists():
        written = judge_result(out, source.truth)
        if written.answer.is_wrong or not found:
            return written
    if found:
        return found
    return Judged(Answer.HALF, "no result") if command in ("calibrate", "solve") else Judged(Answer.RIGHT)


def _file_names(recording: Path) -> Sequence[str]:
    files = sorted(file for file in recording.rglob("*") if file.is_file())
    return [file.name for file in files[:_FEW_FILES]]

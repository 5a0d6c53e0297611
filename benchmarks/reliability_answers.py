"""The answer of a run: a right result, a message, or one of the ways to be wrong."""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from calgraph.errors import CalgraphError
from calgraph.geometry import se3
from calgraph.result import Calibration, load_calibration
from calgraph.simulation import GroundTruth
from reliability_runs import MAX_BYTES, Ending

MAX_SIGMAS = 5.0
"""A pose that is further from the ground truth along an axis, in its stated standard deviations, is wrong."""
RESULT_FILES = (
    "calibration.yaml",
    "captures.csv",
    "report.html",
    "residuals.csv",
    "rig.resolved.yaml",
    "scene.npz",
)
_LEFT = re.compile(r"\.tmp$")
_MIN_NAME = 3
"""Shorter names would be found in any message by chance."""


class Answer(Enum):
    """What a run gave."""

    RIGHT = "right"
    """Exit code 0; every pose within 5 of its standard deviations from the ground truth."""
    WEAK = "weak"
    """A pose is further away, and its verdict is not good, as the result states."""
    REFUSED = "refused"
    """Exit code 1 or 2, and lines that name what is wrong; nothing half written."""
    TRACEBACK = "traceback"
    CRASH = "crash"
    """Ended by a signal that was not sent, or with another exit code."""
    HANG = "time limit"
    MEMORY = "memory"
    SILENT = "no cause named"
    """Refused without a line that names a file, a key or a sensor."""
    FOREIGN = "text of a library"
    """Something else than messages of calgraph on standard error."""
    HALF = "half written"
    LEFT = "files or processes left"
    CONFIDENT = "confidently wrong"
    """A pose graded good is further from the ground truth than 5 of its standard deviations."""

    @property
    def is_wrong(self) -> bool:
        """Whether this must not happen."""
        return self not in (Answer.RIGHT, Answer.WEAK, Answer.REFUSED)


@dataclass(frozen=True)
class Judged:
    """An answer with what led to it."""

    answer: Answer
    detail: str = ""


def judge_ending(ending: Ending, names: Iterable[str], codes: Collection[int] = (0, 1, 2)) -> Judged | None:
    """What is wrong with a run by its end and its texts alone, or REFUSED; None if it ended with exit code 0.

    Args:
        ending: of the run.
        names: of files, keys and sensors, one of which a refusal must contain.
        codes: exit codes that are allowed.
    """
    if ending.hung:
        return Judged(Answer.HANG, f"{ending.seconds:.0f} s")
    if "Traceback" in ending.stderr or "Traceback" in ending.stdout:
        return Judged(Answer.TRACEBACK, ending.stderr.strip().splitlines()[-1])
    if ending.code not in codes:
        return Judged(Answer.CRASH, f"exit code {ending.code}: {ending.stderr[-300:]}")
    if ending.peak > MAX_BYTES:
        return Judged(Answer.MEMORY, f"{ending.peak >> 20} MB")
    if ending.orphans:
        return Judged(Answer.LEFT, f"{ending.orphans} processes")
    lines = ending.stderr.splitlines()
    foreign = [line for line in lines if not re.match(r"calgraph: |Wrote |Usage: |Try '|[╭│╰]|$", line)]
    if foreign:
        return Judged(Answer.FOREIGN, foreign[0])
    if ending.code == 0:
        return None
    if ending.code not in (1, 2):
        return Judged(Answer.REFUSED, f"exit code {ending.code}")
    # What is not calibrated, or fails a check, may be in the tables of standard output.
    text = " ".join((ending.stderr + (ending.stdout if ending.code == 1 else "")).split())
    if not any(name in text for name in names if len(name) >= _MIN_NAME):
        return Judged(Answer.SILENT, text[:300] or "nothing on standard error")
    return Judged(Answer.REFUSED, text)


def judge_result(out: Path, truth: GroundTruth) -> Judged:
    """Whether the poses in a folder of results are right."""
    missing = [name for name in RESULT_FILES if not (out / name).is_file()]
    if missing:
        return Judged(Answer.HALF, f"{', '.join(missing)} missing")
    try:
        calibration = load_calibration(out / "calibration.yaml")
    except CalgraphError as error:
        return Judged(Answer.HALF, str(error))
    return judge_poses(calibration, truth)


def judge_poses(calibration: Calibration, truth: GroundTruth) -> Judged:
    """Whether poses agree with the ground truth; sensors that the ground truth lacks are left out."""
    far = []
    for sensor in calibration.sensors:
        if sensor.name == calibration.root or not {sensor.name, calibration.root} <= set(truth.T_root_sensor):
            continue
        T_root_true = se3.inverse(truth.T_root_sensor[calibration.root]) @ truth.T_root_sensor[sensor.name]
        error = se3.difference(sensor.T_root_sensor, T_root_true)
        variances = np.diag(sensor.covariance)
        measured = np.isfinite(variances)
        sigmas = np.abs(error[measured]) / np.sqrt(np.maximum(variances[measured], 1e-300))
        if sigmas.max(initial=0.0) > MAX_SIGMAS:
            far.append((sensor.verdict.grade, f"{sensor.name} ({sensor.verdict.grade}): {sigmas.max():.1f} sigma"))
    if not far:
        return Judged(Answer.RIGHT)
    good = any(grade == "good" for grade, _ in far)
    return Judged(Answer.CONFIDENT if good else Answer.WEAK, "; ".join(text for _, text in far))


def find_left(*folders: Path) -> list[str]:
    """Temporary files and folders, in these folders and in those directly below."""
    places = [
        *folders,
        *(one for folder in folders if folder.is_dir() for one in folder.iterdir() if one.is_dir()),
    ]
    return [
        str(entry)
        for place in dict.fromkeys(places)
        if place.is_dir()
        for entry in place.iterdir()
        if _LEFT.search(entry.name)
    ]

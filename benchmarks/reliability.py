"""What calgraph answers to recordings of failed sensors and recorders: the tables of docs/reliability.md.

python benchmarks/reliability.py --jobs 4                      # both tables
python benchmarks/reliability.py --only "stamps" --keep wrong  # some kinds; inputs of wrong answers are kept

Each recording is one run of the installed command line in a separate folder: calibrate, and also inspect, init and
check. Bytes that are damaged are the matter of fuzz_readers.py.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

import numpy as np
import psutil

from calgraph.errors import CalgraphError
from calgraph.geometry import se3
from calgraph.result import Calibration, load_calibration
from calgraph.simulation import GroundTruth
from reliability_messages import FORMS, MESSAGE_DAMAGE, Source, read_source, simulate_source, write_rig
from worlds import grouped, make_parser, run_worlds

MAX_SECONDS = 120.0
"""A run that takes longer has failed. The small recordings here take 3 s on an idle core."""
MAX_BYTES = 2**30
"""Largest resident set of one process of a run."""
_LONGEST_END = 20.0
"""Processes that a run has started must have ended this long after it, s; a loaded machine needs a few."""
MAX_SIGMAS = 5.0
"""A pose that is further from the ground truth along an axis, in its stated standard deviations, is wrong."""
RESULT_FILES = (
    "budget.csv",
    "calibration.yaml",
    "captures.csv",
    "report.html",
    "residuals.csv",
    "rig.resolved.yaml",
    "scene.npz",
)
_ENDED = psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD
_LEFT = re.compile(r"\.tmp$")
_MIN_NAME = 3
"""Shorter names would be found in any message by chance."""
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
_FEW_FILES = 12


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


@dataclass(frozen=True)
class Outcome:
    """The answer to one recording."""

    kind: str
    """Of damage."""
    form: str
    """Of the recording."""
    seed: int
    answer: str
    """Name of an :class:`Answer`."""
    detail: str

    @property
    def judged(self) -> Judged:
        """The answer with what led to it."""
        return Judged(Answer[self.answer], self.detail)


COLUMNS: Mapping[str, Callable[[Answer], bool]] = {
    "tried": lambda _: True,
    "right": lambda one: one is Answer.RIGHT,
    "weak": lambda one: one is Answer.WEAK,
    "refused": lambda one: one is Answer.REFUSED,
    "wrong": lambda one: one.is_wrong,
}
ROWS: Mapping[str, Collection[str]] = {"damage of the recording": MESSAGE_DAMAGE, "form of the recording": FORMS}
"""Of both tables, by their heads."""


def main() -> None:
    """Prints the tables, and the wrong answers; exit code 1 if there are any."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--seeds", type=int, default=2, help="of each kind and form")
    parser.add_argument("--only", default="", help="kinds and forms whose names contain this")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of wrong answers")
    arguments = parser.parse_args()
    with TemporaryDirectory(prefix="reliability ") as scratch:
        folder = Path(scratch) / "source"
        if not arguments.show:
            write_extrinsics(simulate_source(folder, seed=0))
        cases = product(range(arguments.seeds), MESSAGE_DAMAGE, FORMS)
        work = [
            (kind, form, seed, folder, arguments.keep)
            for seed, kind, form in cases
            if arguments.only in f"{kind}: {form}"
        ]
        outcomes = run_worlds(Outcome, attempt, work, arguments, key=3)
    for head in ROWS:
        print(f"{format_table(outcomes, head)}\n")
    wrong = [one for one in outcomes if one.judged.answer.is_wrong]
    for one in wrong:
        print(f"- {one.kind}: {one.form}: {one.seed}: {one.judged.answer.value}: {one.detail}")
    print(f"{len(outcomes)} recordings; {len(wrong)} wrong")
    sys.exit(1 if wrong else 0)


def format_table(outcomes: Iterable[Outcome], head: str) -> str:
    """A Markdown table with a row for each kind or form, and their sum."""
    names = list(ROWS[head])
    at = list(ROWS).index(head)
    ordered = sorted(outcomes, key=lambda one: names.index((one.kind, one.form)[at]))
    rows = [f"| {head} | {' | '.join(COLUMNS)} |", f"| --- |{' ---: |' * len(COLUMNS)}"]
    for name, group in [*grouped(ordered, lambda one: (one.kind, one.form)[at]), ("**all**", ordered)]:
        counts = (sum(test(one.judged.answer) for one in group) for test in COLUMNS.values())
        rows.append(f"| {name} | {' | '.join(map(str, counts))} |")
    return "\n".join(rows)


def write_extrinsics(source: Source) -> None:
    """Poses to check against, from the recording as it is."""
    write_rig(source.folder / "rig.yaml", source.rig)
    ending = run([part.format(recording="recording") for part in _CALIBRATE], source.folder)
    if ending.code:
        sys.exit(f"the recording as it is: {ending.stderr}")
    (source.folder / "out" / "calibration.yaml").rename(source.folder / "extrinsics.yaml")


def attempt(kind: str, form: str, seed: int, folder: Path, keep: Path | None) -> Outcome:
    """Damages the recording in a folder, and runs a command on it; the same case has the same random numbers."""
    number = zlib.crc32(f"recordings: {kind}: {form}: {seed}".encode())
    source = _read_source(folder)
    with TemporaryDirectory(prefix="case ") as scratch:
        case = Path(scratch)
        items = MESSAGE_DAMAGE[kind](source.items, np.random.default_rng(number))
        judged = judge_recording(source, form, FORMS[form](case / "recording", items), case, seed)
        if keep and judged.answer.is_wrong:
            shutil.copytree(case, keep / f"case {number:08x}", dirs_exist_ok=True)
    return Outcome(kind, form, seed, judged.answer.name, judged.detail)


_read_source = cache(read_source)


def judge_recording(source: Source, form: str, recording: Path, folder: Path, seed: int) -> Judged:
    """Runs the command of a seed on a recording, and judges its answer."""
    write_rig(folder / "rig.yaml", source.rig_of(form))
    command = _COMMANDS[seed % len(_COMMANDS)]
    places = {"recording": recording.name, "extrinsics": source.folder / "extrinsics.yaml"}
    ending = run([part.format(**places) for part in command], folder)
    files = sorted(file.name for file in recording.rglob("*") if file.is_file())
    names = [recording.name, *source.rig["sensors"], "capture", "board", *files[:_FEW_FILES]]
    found = judge_ending(ending, names)
    if found and found.answer.is_wrong:
        return found
    if left := find_left(folder):
        return Judged(Answer.LEFT, left[0])
    if (folder / "out").exists():
        # What a command wrote must be complete, and right if it exits with 0.
        written = judge_result(folder / "out", source.truth)
        if written.answer.is_wrong or not found:
            return written
    if found:
        return found
    return Judged(Answer.HALF, "no result") if command[0] == "calibrate" else Judged(Answer.RIGHT)


def find_command() -> Sequence[str]:
    """The installed program, beside this interpreter or on the path."""
    beside = Path(sys.executable).with_name("calgraph")
    found = str(beside) if beside.is_file() else shutil.which("calgraph")
    if found is None:
        sys.exit("calgraph is not installed in this environment")
    return [found]


def run(arguments: Sequence[object], cwd: Path, program: Sequence[str] | None = None) -> Ending:
    """Runs one command to its end.

    Args:
        arguments: of calgraph.
        cwd: folder in which it runs.
        program: instead of the installed one.
    """
    command = [*(program or find_command()), *map(str, arguments)]
    # Each case has a separate cache of detections.
    variables = {**os.environ, "CALGRAPH_CACHE": str(cwd / "cache")}
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        began = time.monotonic()
        process = subprocess.Popen(
            command, cwd=cwd, env=variables, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr,
            start_new_session=True,
        )  # fmt: skip
        late = threading.Timer(MAX_SECONDS, _kill_session, [process.pid])
        late.start()
        # wait4 returns the usage of this one process; that of all children would mix the runs.
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.monotonic() - began
        late.cancel()
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
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):  # it has ended
            if os.getsid(process.pid) == session and process.status() not in _ENDED:
                found.append(process.pid)
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
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def judge_ending(ending: Ending, names: Iterable[str]) -> Judged | None:
    """What is wrong with a run by its end and its texts alone, or REFUSED; None if it ended with exit code 0.

    Args:
        ending: of the run.
        names: of files, keys and sensors, one of which a refusal must contain.
    """
    if ending.hung:
        return Judged(Answer.HANG, f"{ending.seconds:.0f} s")
    if "Traceback" in ending.stderr or "Traceback" in ending.stdout:
        return Judged(Answer.TRACEBACK, ending.stderr.strip().splitlines()[-1])
    if ending.code not in (0, 1, 2):
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


if __name__ == "__main__":
    main()

"""Cases of the reliability tables, and how they are attempted: each in a separate folder, by several threads."""

import shutil
import time
import zlib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged


@dataclass(frozen=True)
class Case:
    """One input or fault."""

    table: str
    kind: str
    """Its row."""
    form: str
    """What is damaged or disturbed: the form of a recording, a command."""
    seed: int
    attempt: Callable[[Path, np.random.Generator], Judged]
    """Carries it out in an empty folder."""

    @property
    def name(self) -> str:
        """Unique among all cases."""
        return f"{self.table}: {self.kind}: {self.form}: {self.seed}"

    @property
    def number(self) -> int:
        """The same name gives the same random numbers, with any other cases."""
        return zlib.crc32(self.name.encode())


@dataclass(frozen=True)
class Outcome:
    """The answer in one case."""

    table: str
    kind: str
    form: str
    name: str
    answer: str
    """Name of an :class:`Answer`."""
    detail: str = ""

    @property
    def judged(self) -> Judged:
        """The answer with what led to it."""
        return Judged(Answer[self.answer], self.detail)


def attempt_all(
    cases: Iterable[Case],
    scratch: Path,
    jobs: int,
    keep: Path | None,
    report: Callable[[Outcome], None],
    end: float,
) -> None:
    """Attempts cases, several at a time, in random order.

    Args:
        cases: to attempt.
        scratch: folder for those of the cases.
        jobs: how many at a time.
        keep: folder that keeps those of wrong answers.
        report: called with each outcome.
        end: time of the monotonic clock at which no further case is begun, s.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    shuffled = sorted(cases, key=lambda case: case.number)
    with ThreadPoolExecutor(jobs) as pool:
        for outcome in pool.map(partial(_attempt, scratch=scratch, keep=keep, end=end), shuffled):
            if outcome:
                report(outcome)


def _attempt(case: Case, scratch: Path, keep: Path | None, end: float) -> Outcome | None:
    if time.monotonic() > end:
        return None
    folder = scratch / f"case {case.number:08x}"
    folder.mkdir()
    try:
        judged = case.attempt(folder, np.random.default_rng(case.number))
    except Exception as error:
        judged = Judged(Answer.FOREIGN, f"the benchmark failed: {type(error).__name__}: {error}")
    if keep and judged.answer.is_wrong:
        keep.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(keep / folder.name, ignore_errors=True)
        shutil.copytree(folder, keep / folder.name, symlinks=True, ignore=_ignore_special)
        (keep / folder.name / "case.txt").write_text(f"{case.name}\n{judged.answer.value}: {judged.detail}\n")
    shutil.rmtree(folder, ignore_errors=True)
    return Outcome(case.table, case.kind, case.form, case.name, judged.answer.name, judged.detail)


def _ignore_special(folder: str, names: list[str]) -> set[str]:
    """FIFOs and devices cannot be copied."""
    return {name for name in names if not (Path(folder) / name).is_dir() and not (Path(folder) / name).is_file()}

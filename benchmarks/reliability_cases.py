"""Cases of the reliability tables, and how they are carried out: each in a separate folder, by several threads."""

import shutil
import zlib
from collections.abc import Callable, Iterable, Sequence
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


@dataclass(frozen=True)
class Outcome:
    """A case with its answer."""

    case: Case
    judged: Judged


def attempt_all(
    cases: Iterable[Case], scratch: Path, jobs: int, keep: Path | None, report: Callable[[Outcome], None]
) -> Sequence[Outcome]:
    """Carries out cases, several at a time; folders of wrong answers are kept where ``keep`` names a folder."""
    scratch.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(jobs) as pool:
        outcomes = []
        for outcome in pool.map(partial(_attempt, scratch=scratch, keep=keep), cases):
            report(outcome)
            outcomes.append(outcome)
    return outcomes


def _attempt(case: Case, scratch: Path, keep: Path | None) -> Outcome:
    """The same name gives the same random numbers, with any other cases."""
    number = zlib.crc32(case.name.encode())
    folder = scratch / f"case {number:08x}"
    folder.mkdir()
    try:
        judged = case.attempt(folder, np.random.default_rng(number))
    except Exception as error:
        judged = Judged(Answer.FOREIGN, f"the benchmark failed: {type(error).__name__}: {error}")
    if keep and judged.answer.is_wrong:
        keep.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(keep / folder.name, ignore_errors=True)
        shutil.copytree(folder, keep / folder.name, symlinks=True, ignore=_ignore_special)
        (keep / folder.name / "case.txt").write_text(f"{case.name}\n{judged.answer.value}: {judged.detail}\n")
    shutil.rmtree(folder, ignore_errors=True)
    return Outcome(case, judged)


def _ignore_special(folder: str, names: list[str]) -> set[str]:
    """FIFOs and devices cannot be copied."""
    return {name for name in names if not (Path(folder) / name).is_dir() and not (Path(folder) / name).is_file()}

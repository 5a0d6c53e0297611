"""Groups, averages and rows of runs, for the tables of benchmarks. Averages are of the finite values."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calgraph.geometry import Array

Run = TypeVar("Run")
Key = TypeVar("Key")
NAN = float("nan")


def grouped(runs: Iterable[Run], key: Callable[[Run], Key]) -> list[tuple[Key, list[Run]]]:
    """Runs by a key, in the order in which keys come first."""
    groups: dict[Key, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.items())


def finite(values: Sequence[float] | Array) -> Array:
    """(N,) the finite ones."""
    numbers = np.array(values, dtype=np.float64)
    return numbers[np.isfinite(numbers)]


def mean(values: Sequence[float] | Array) -> float:
    """NaN if there is none."""
    return float(finite(values).mean()) if len(finite(values)) else NAN


def rms(values: Sequence[float] | Array) -> float:
    """Root mean square; NaN if there is none."""
    return float(np.sqrt(mean(np.square(values))))


def median(values: Sequence[float] | Array) -> float:
    """NaN if there is none."""
    return float(np.median(finite(values))) if len(finite(values)) else NAN


def worst(values: Sequence[float] | Array) -> float:
    """The largest; 0 if there is none."""
    return float(finite(values).max(initial=0.0))


def share(part: Sequence[object], whole: Sequence[object]) -> str:
    """As a percentage."""
    return f"{len(part) / len(whole):.1%}" if whole else "-"


def save_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes a row for each run; columns are those of the first."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)

"""The harness of benchmarks: worlds that are run and resumed, rows in a CSV file, figures and lines of tables.

A benchmark draws worlds, measures each in a function that returns its row or rows, and prints a table of them.
Rows are dataclasses or named tuples of texts, numbers and arrays, whose first fields are the name of their world.
Averages are those of finite values.
"""

import argparse
import csv
import json
import logging
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, get_type_hints

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.parallel.engine import Processes
from calgraph.result import Calibration

Row = TypeVar("Row")
Key = TypeVar("Key")
NAN = float("nan")
_READ: dict[type, Callable[[str], Any]] = {bool: "True".__eq__, int: int, float: float}
_BLOCK = 5
"""Worlds of each process before a new one."""


def make_parser(text: str | None, *, jobs: int = 0, path: Path | None = None) -> argparse.ArgumentParser:
    """A command line that shows the text of its module.

    Args:
        text: of the module.
        jobs: default number of processes; there is no such option if 0.
        path: default of ``--csv``, the file that is resumed.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if jobs:
        parser.add_argument("--jobs", type=int, default=jobs, help="processes")
        parser.add_argument(
            "--csv", type=Path, default=path, help="file of all rows; worlds in it are not run again"
        )
        parser.add_argument("--show", type=Path, nargs="+", default=[], help="such files alone, instead of runs")
    return parser


def run_worlds(
    kind: type[Row],
    function: Callable[..., Row | Sequence[Row] | None],
    work: Sequence[tuple[Any, ...]],
    arguments: argparse.Namespace,
    key: int,
) -> list[Row]:
    """The rows of all worlds: those of the file, and of the others as they are run and appended to it.

    Args:
        kind: of a row.
        function: of a world: its row, its rows, or None where there is no such world.
        work: arguments of the function by world.
        arguments: of :func:`make_parser`.
        key: number of first fields of a row, and arguments of the function, that identify a world.
    """
    if arguments.show:
        return [row for path in arguments.show for row in read_rows(kind, path)]
    found = read_rows(kind, arguments.csv)
    wanted = {_text(one[:key]) for one in work}
    done = {_text(_values(row)[:key]) for row in found}
    missing = [one for one in work if _text(one[:key]) not in done]
    rows = [row for row in found if _text(_values(row)[:key]) in wanted]
    seconds = 0.0
    logging.disable(logging.WARNING)
    for first in range(0, len(missing), _BLOCK * arguments.jobs):
        block = [(function, *one) for one in missing[first : first + _BLOCK * arguments.jobs]]
        for new, taken in Processes(arguments.jobs).map(_measure, block):
            append_rows(kind, new, arguments.csv)
            rows += new
            seconds += taken
        print(f"\r{first + len(block)} of {len(missing)} worlds", end="", file=sys.stderr, flush=True)
    logging.disable(logging.NOTSET)
    print(file=sys.stderr)
    if missing:
        print(f"{len(missing)} worlds, {seconds:.0f} s of CPU, {seconds / len(missing):.2f} s each")
    return rows


def _measure(function: Callable[..., Row | Sequence[Row] | None], *arguments: object) -> tuple[list[Row], float]:
    """The rows of a world, and the processor time that it took, s."""
    began = time.process_time()
    found = function(*arguments)
    rows = found if isinstance(found, list) else [] if found is None else [cast(Row, found)]
    return rows, time.process_time() - began


def _values(row: object) -> tuple[Any, ...]:
    return (
        tuple(getattr(row, one.name) for one in fields(row)) if is_dataclass(row) else cast(tuple[Any, ...], row)
    )


def _write(value: object) -> object:
    """As it is in a file: arrays as JSON, with all digits."""
    return json.dumps(value.tolist()) if isinstance(value, np.ndarray) else value


def _read(text: str, hint: Any) -> object:
    return np.array(json.loads(text), dtype=np.float64) if hint == Array else _READ.get(hint, str)(text)


def _text(values: Sequence[Any]) -> tuple[str, ...]:
    return tuple(map(str, values))


def _names(kind: type[Row]) -> list[str]:
    return [one.name for one in fields(kind)] if is_dataclass(kind) else list(cast(Any, kind)._fields)


def read_rows(kind: type[Row], path: Path | None) -> list[Row]:
    """The rows of a file; none if there is no such file."""
    if path is None or not path.exists():
        return []
    hints, names = get_type_hints(kind), _names(kind)
    with path.open(newline="", encoding="utf-8") as file:
        return [kind(**{name: _read(one[name], hints[name]) for name in names}) for one in csv.DictReader(file)]


def append_rows(kind: type[Row], rows: Iterable[Row], path: Path | None) -> None:
    """Appends rows to a file, if there is to be one."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerows([_names(kind)] if new else [])
        writer.writerows(map(_write, _values(row)) for row in rows)


class PoseError(NamedTuple):
    """How far a pose is off, and by its covariance."""

    metres: float
    degrees: float
    sigmas: float
    """Worst along or about an axis."""
    nees: float
    """Squared Mahalanobis distance per degree of freedom."""
    axes: Array
    """(6,) m and rad."""


def measure_error(T: Array, covariance: Array, T_true: Array) -> PoseError:
    """The error of a pose (4, 4) with a covariance (6, 6)."""
    off = se3.difference(T, T_true)
    metres, degrees = float(np.linalg.norm(off[:3])), float(np.degrees(np.linalg.norm(off[3:])))
    sigmas = float(np.max(np.abs(off) / np.sqrt(np.diag(covariance))))
    return PoseError(metres, degrees, sigmas, float(off @ np.linalg.solve(covariance, off) / 6), off)


def find_errors(found: Calibration, T_true: Mapping[str, Array]) -> dict[str, PoseError]:
    """By sensor besides the root of a result, which may be another one than that of the true poses (4, 4)."""
    T_root = se3.inverse(T_true[found.root])
    return {
        sensor.name: measure_error(sensor.T_root_sensor, sensor.covariance, T_root @ T_true[sensor.name])
        for sensor in found.sensors
        if sensor.name != found.root
    }


@dataclass(frozen=True)
class Layout:
    """Columns of a table, as ``head:format`` separated by spaces; an underscore stands for a space in a head."""

    columns: str

    @property
    def head(self) -> str:
        """The line of heads, aligned as their columns."""
        cells = []
        for one in self.columns.split():
            name, _, form = one.rpartition(":")
            width = int("".join(c for c in form.partition(".")[0] if c.isdigit()))
            text = form[-1] not in "dfg%" and ">" not in form
            cells.append(f"{name.replace('_', ' '):{'<' if text else '>'}{width}}")
        return " ".join(cells).rstrip()

    def line(self, *values: object) -> str:
        """The line of some values."""
        forms = [one.rpartition(":")[2] for one in self.columns.split()]
        return " ".join(f"{value:{form}}" for value, form in zip(values, forms, strict=True))


def grouped(rows: Iterable[Row], key: Callable[[Row], Key]) -> list[tuple[Key, list[Row]]]:
    """Rows by a key, in the order in which keys come first."""
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
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

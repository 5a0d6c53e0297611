"""The harness of benchmarks: worlds are resumed from their file, and heads stand above their columns."""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from calgraph.geometry import Array, se3
from worlds import Layout, append_rows, measure_error, read_rows, run_worlds


@dataclass(frozen=True)
class Square:
    """A row."""

    name: str
    number: int
    square: float
    odd: bool


class Pair(NamedTuple):
    """Another kind of row."""

    number: int
    text: str


def square(name: str, number: int) -> Square | None:
    return None if number == 3 else Square(name, number, number**2 / 4, number % 2 == 1)


def test_worlds_of_the_file_are_not_run_again(tmp_path: Path) -> None:
    arguments = Namespace(jobs=1, csv=tmp_path / "new" / "rows.csv", show=[])
    first = run_worlds(Square, square, [("a", 1), ("a", 2), ("a", 3)], arguments, key=2)
    assert first == [Square("a", 1, 0.25, odd=True), Square("a", 2, 1.0, odd=False)]

    def other(name: str, number: int) -> list[Square]:
        return [Square(name, number, -1.0, odd=False)] * 2

    again = run_worlds(Square, other, [("a", 2), ("b", 5)], arguments, key=2)
    assert again == [first[1], *[Square("b", 5, -1.0, odd=False)] * 2]
    assert read_rows(Square, arguments.csv) == [*first, *again[1:]]
    assert run_worlds(Square, other, [], Namespace(show=[arguments.csv]), key=2) == [*first, *again[1:]]


def test_rows_may_be_named_tuples(tmp_path: Path) -> None:
    rows = [Pair(1, "a, b"), Pair(2, "line\nend")]
    for row in rows:
        append_rows(Pair, [row], tmp_path / "rows.csv")
    assert read_rows(Pair, tmp_path / "rows.csv") == rows
    assert read_rows(Pair, tmp_path / "none.csv") == []


@dataclass(frozen=True, eq=False)
class Measured:
    """A row with an array."""

    name: Literal["a", "b"]
    errors: Array


def test_arrays_are_read_with_all_digits(tmp_path: Path) -> None:
    errors = np.array([[1 / 3, np.nan], [1e-300, np.inf]])
    append_rows(Measured, [Measured("a", errors), Measured("b", np.zeros((0,)))], tmp_path / "rows.csv")
    first, second = read_rows(Measured, tmp_path / "rows.csv")
    assert first.name == "a"
    np.testing.assert_array_equal(first.errors, errors)
    assert second.errors.shape == (0,)


def test_heads_stand_above_their_columns() -> None:
    table = Layout("rig:6 size:>8 runs:4d >_99_%:7.1% mm:6.2f")
    assert table.head == "rig        size runs  > 99 %     mm"
    assert table.line("five", "3 mm", 12, 0.25, 1.5) == "five       3 mm   12   25.0%   1.50"


def test_errors_are_along_all_axes() -> None:
    stddev = np.array([0.001, 0.001, 0.002, 0.01, 0.01, 0.01])
    T = se3.retract(np.eye(4), np.array([0.003, 0.0, 0.004, 0.0, 0.0, 0.0]))
    error = measure_error(T, np.diag(stddev**2), np.eye(4))
    assert error.metres == pytest.approx(0.005)
    assert error.sigmas == pytest.approx(3.0)
    assert error.nees == pytest.approx((9 + 4) / 6)

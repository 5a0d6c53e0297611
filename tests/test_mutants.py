"""Mutants are drawn from places that matter, and the same seed draws the same ones."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cosmic_ray", reason="the extra mutants is not installed")

import mutants
import mutation

FILE = Path("src/calgraph/example.py")
CODE = '''\
"""Text with 1 + 1."""
from dataclasses import dataclass

__all__ = ["f"] + []
LIMIT = 20.0


@dataclass(frozen=True)
class Pair:
    size: int | None = 3


def f(x: float | None, R: list[int]) -> int | None:
    """Doubles 2."""
    for a, b in zip(R, R, strict=True):
        if a < b and x is None:
            return (
                -a
                + 7
            )
    return R.T @ R
'''


def changes(code: str) -> dict[str, set[int]]:
    """Lines by the operator that changes them."""
    found: dict[str, set[int]] = {}
    for mutant in mutation.find_mutants(FILE, code):
        found.setdefault(mutant.operator.split("_")[0], set()).add(mutant.start[0])
    return found


def test_text_annotations_decorators_and_exports_are_not_mutated() -> None:
    assert set().union(*changes(CODE).values()) == {5, 10, 15, 16, 18, 19, 21}


def test_operators_numbers_conditions_loops_and_transposes_are_mutated() -> None:
    assert changes(CODE) == {
        "NumberReplacer": {10, 19},
        "LargeNumberScaler": {5},
        "ZeroIterationForLoop": {15},
        "AddNot": {16},
        "ReplaceAndWithOr": {16},
        "ReplaceComparisonOperator": {16},
        "ReplaceUnaryOperator": {18},
        "ReplaceBinaryOperator": {19},
        "TransposeRemover": {21},
    }


def test_a_mutant_changes_one_place() -> None:
    (mutant,) = [m for m in mutation.find_mutants(FILE, CODE) if m.operator == "TransposeRemover"]
    assert mutant.code(CODE) == CODE.replace("R.T", "R")


def test_large_numbers_are_doubled_or_halved() -> None:
    changed = [m.code("x = 20.0\n") for m in mutation.find_mutants(FILE, "x = 20.0\n")]
    assert changed == ["x = 40.0\n", "x = 10.0\n"]


def test_a_draw_has_one_mutant_of_a_place_and_repeats_with_its_seed() -> None:
    possible = mutation.find_mutants(FILE, CODE)
    drawn = mutation.draw({FILE: CODE}, possible, 8, np.random.default_rng(3))
    assert len({(m.start, m.end) for m in drawn}) == 8
    assert drawn == mutation.draw({FILE: CODE}, possible, 8, np.random.default_rng(3))


def test_mutants_that_are_no_python_are_not_drawn() -> None:
    code = "def f(a, *, b):\n    return a + b\n"
    drawn = mutation.draw({FILE: code}, mutation.find_mutants(FILE, code), 8, np.random.default_rng(0))
    assert [m.start for m in drawn] == [(2, 13)]


@pytest.mark.parametrize(
    ("line", "lines", "imported"),
    [(5, range(5, 6), True), (10, range(10, 11), True), (15, range(15, 16), False), (19, range(17, 21), False)],
)
def test_tests_are_chosen_by_the_lines_of_the_statement(line: int, lines: range, imported: bool) -> None:
    assert mutants.statement_lines(CODE, line) == (lines, imported)

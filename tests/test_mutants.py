"""Mutants are drawn from places that matter, and the same seed draws the same ones."""

from dataclasses import replace
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


MODULE = "def double(x):\n    return 2 * x\n"
TESTS = """\
import pytest
from calgraph.doubling import double


def test_zero():
    assert double(0) == 0


def test_that_always_fails():
    assert double(1) == 3


@pytest.mark.slow
def test_one():
    assert double(1) == 2
"""


@pytest.mark.parametrize(
    ("code", "first", "slow", "test"),
    [
        ("def double(x):\n    return 2 * x + 1\n", "first", None, "test_zero"),
        ("def double(x):\n    return 4 * x\n", "open", "slow", "test_one"),
        ("def double(x):\n    return x * 2\n", "open", "survived", None),
    ],
)
def test_a_mutant_dies_by_the_first_test_that_passes_without_it(
    tmp_path: Path, code: str, first: str, slow: str | None, test: str | None
) -> None:
    module = tmp_path / "src/calgraph/doubling.py"
    module.parent.mkdir(parents=True)
    (module.parent / "__init__.py").touch()
    module.write_text(MODULE)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_doubling.py").write_text(TESTS)
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["slow: slow"]\n')
    row = mutants.Row("src/calgraph/doubling.py", 2, 11, "ReplaceBinaryOperator_Mul_Add", 0, "")
    left_out: set[str] = set()
    tests = [Path("tests/test_doubling.py")]
    done = mutants.judge(row, "first", code, tests, left_out, tmp_path)
    assert done.outcome == first
    if slow:
        done = mutants.judge(done, "slow", code, tests, left_out, tmp_path)
        assert done.outcome == slow
        assert left_out == {"tests/test_doubling.py::test_that_always_fails"}
    assert done.test == (f"tests/test_doubling.py::{test}" if test else "")
    assert done.seconds > 0.1
    assert module.read_text() == MODULE


def test_a_run_is_continued_from_its_file(tmp_path: Path) -> None:
    rows = [
        mutants.Row("src/calgraph/a.py", line, 0, "AddNot", line, "0a1b", "first", "test_a", 1.5)
        for line in (1, 2)
    ]
    record = mutants.Record(tmp_path / "build/7.csv")
    for row in rows:
        record.put(replace(row, outcome="open"))
        record.put(row)
    again = mutants.Record(tmp_path / "build/7.csv")
    again.load()
    assert list(again.rows.values()) == rows


def test_the_shares_of_both_tiers_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    drawn = mutation.draw({FILE: CODE}, mutation.find_mutants(FILE, CODE), 4, np.random.default_rng(3))
    outcomes = ("first", "first", "slow", "survived")
    rows = {
        mutant: mutants.Row(str(FILE), *mutant.start, mutant.operator, 0, "", outcome, seconds=60.0)
        for mutant, outcome in zip(drawn, outcomes, strict=True)
    }
    mutants.show(rows, {FILE: CODE})
    printed = capsys.readouterr().out
    assert printed.count("survived\n") == 1
    assert "Of 4 mutants, 2 die in the first tier (50.0 %), 1 by slow tests\n(75.0 % in both); 4.0 min" in printed

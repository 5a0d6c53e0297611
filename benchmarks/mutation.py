"""What a mutation test changes in a file: mutants of cosmic-ray's operators, and of two more.

``mutants.py`` draws from them and runs the tests.
"""

import ast
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import parso
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.plugins import get_operator, operator_names

_FAMILIES = (
    {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"},
    {"BitAnd", "BitOr", "BitXor"},
    {"LShift", "RShift"},
    {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"},
    {"Is", "IsNot"},
)
"""Operators replace each other within a family; across families nearly all mutants end in a TypeError."""
_OTHERS = {
    "AddNot", "ExceptionReplacer", "NumberReplacer", "ReplaceAndWithOr", "ReplaceBreakWithContinue",
    "ReplaceContinueWithBreak", "ReplaceFalseWithTrue", "ReplaceOrWithAnd", "ReplaceTrueWithFalse",
    "ReplaceUnaryOperator_Delete_Invert", "ReplaceUnaryOperator_Delete_Not", "ReplaceUnaryOperator_Delete_USub",
    "ZeroIterationForLoop",
}  # fmt: skip

Position = tuple[int, int]


class TransposeRemover(Operator):  # type: ignore[misc]
    """Removes ``.T``."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Position, Position]]:
        """The trailer, if it is ``.T``."""
        if node.type == "trailer" and node.get_code(include_prefix=False) == ".T":
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:  # noqa: ARG002  cosmic-ray's signature
        """An empty trailer in its place."""
        return parso.python.tree.PythonNode("trailer", [])

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        """What cosmic-ray shows in its documentation."""
        return (Example("a.T @ b", "a @ b"),)


def is_large(node: Any) -> bool:
    """Whether a node is a number that one more or less hardly changes."""
    if node.type != "number":
        return False
    value = ast.literal_eval(node.value)
    return bool(abs(value) >= (10 if isinstance(value, int) else 3.0))


class LargeNumberScaler(Operator):  # type: ignore[misc]
    """Doubles or halves numbers that cosmic-ray's steps of one hardly change."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Position, Position]]:
        """Twice the number's position."""
        if is_large(node):
            yield from 2 * [(node.start_pos, node.end_pos)]

    def mutate(self, node: Any, index: int) -> Any:
        """Twice the number, or half of it."""
        value = ast.literal_eval(node.value)
        scaled = 2 * value if index == 0 else value // 2 if isinstance(value, int) else value / 2
        return parso.python.tree.Number(f" {scaled}", node.start_pos)

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        """What cosmic-ray shows in its documentation."""
        return (Example("x = 20", "x = 40"), Example("x = 5.0", "x = 2.5", occurrence=1))


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    file: Path
    """Relative to the checkout."""
    operator: str
    occurrence: int
    """Which of all places that the operator can change in the file."""
    start: Position
    """Line from 1, column from 0."""
    end: Position

    def code(self, original: str) -> str:
        """The whole file with the change."""
        return str(mutate_code(original, _operators()[self.operator](), self.occurrence))


def _operators() -> dict[str, type[Operator]]:
    chosen: dict[str, type[Operator]] = {
        "TransposeRemover": TransposeRemover,
        "LargeNumberScaler": LargeNumberScaler,
    }
    for full in operator_names():
        name = full.removeprefix("core/")
        kind, _, pair = name.partition("_")
        both = set(pair.split("_"))
        swap = kind in ("ReplaceBinaryOperator", "ReplaceComparisonOperator")
        if name in _OTHERS or (swap and any(both <= family for family in _FAMILIES)):
            chosen[name] = get_operator(full)
    return chosen


def skipped_spans(code: str) -> list[tuple[Position, Position]]:
    """Parts of a file that are not mutated: start and end, line from 1 and column from 0."""
    found: list[ast.expr | ast.stmt | None] = []
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Import() | ast.ImportFrom():
                found.append(node)
            case ast.FunctionDef():
                found += [*node.decorator_list, node.returns]
            case ast.ClassDef():
                found += node.decorator_list
            case ast.arg() | ast.AnnAssign():
                found.append(node.annotation)
            case ast.Assign(targets=[ast.Name(id="__all__")]):
                found.append(node)
            case ast.Call(func=ast.Name(id="zip")):
                found += [keyword.value for keyword in node.keywords]
    return [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in found
        if node
    ]


def find_mutants(file: Path, code: str) -> list[Mutant]:
    """All mutants of a file."""
    skipped = skipped_spans(code)
    nodes = list(ast_nodes(get_ast(code)))
    large = {node.start_pos for node in nodes if is_large(node)}
    mutants = []
    for name, operator in _operators().items():
        places = [place for node in nodes for place in operator().mutation_positions(node)]
        for occurrence, (start, end) in enumerate(places):
            scaled_instead = name == "NumberReplacer" and start in large
            if not scaled_instead and not any(first <= start and end <= last for first, last in skipped):
                mutants.append(Mutant(file, name, occurrence, start, end))
    return mutants


def draw(originals: dict[Path, str], mutants: list[Mutant], count: int, rng: np.random.Generator) -> list[Mutant]:
    """At most ``count`` mutants at different places: places are drawn evenly, then a mutant of each.

    Those that are no Python are left out: cosmic-ray takes the asterisk before keyword-only parameters for a
    product.
    """
    places: dict[tuple[Path, Position, Position], list[Mutant]] = defaultdict(list)
    for mutant in mutants:
        places[mutant.file, mutant.start, mutant.end].append(mutant)
    in_order = [places[key] for key in sorted(places)]
    shuffled = (in_order[k][rng.integers(len(in_order[k]))] for k in rng.permutation(len(in_order)))
    valid = (mutant for mutant in shuffled if is_python(mutant.code(originals[mutant.file])))
    return sorted(islice(valid, count), key=lambda mutant: (mutant.file, mutant.start))


def is_python(code: str) -> bool:
    """Whether the code can be compiled."""
    try:
        ast.parse(code)
    except SyntaxError:
        return False
    return True

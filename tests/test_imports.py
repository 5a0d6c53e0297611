"""The modules of calgraph import each other without cycles."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import calgraph

SOURCE = Path(calgraph.__file__).parent
FILES = {
    ".".join(("calgraph", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(SOURCE.rglob("*.py"))
}


def imported(module: str) -> set[str]:
    """The modules of calgraph that a module imports anywhere: at its top, for type checkers, or in a function.

    A name that a package re-exports counts as an import of the package.
    """
    found = set()
    for node in ast.walk(ast.parse(FILES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in FILES else node.module for name in names}
    return (found & FILES.keys()) - {module}


def test_there_are_no_import_cycles() -> None:
    try:
        tuple(TopologicalSorter({module: imported(module) for module in FILES}).static_order())
    except CycleError as error:
        pytest.fail(f"import cycle: {' → '.join(error.args[1])}")

"""Which tests run on a mutant: those that mirror the mutated module, and those that import it."""

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

SOURCE = Path("src/calgraph")
HELPERS = ("tests", "benchmarks")
"""Folders with modules that tests import."""
WHOLE_COMMANDS = ("tests/cli", "tests/end_to_end")
"""Folders with tests that execute any module."""


def module_name(file: Path) -> str:
    """Name of a module of calgraph, by its path in the checkout."""
    return ".".join(file.relative_to("src").with_suffix("").parts).removesuffix(".__init__")


def imported_names(code: str) -> Iterator[tuple[str, str]]:
    """Module and name of each import anywhere in a file; no name where the module itself is imported."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


@dataclass(frozen=True)
class Selection:
    """Chooses test files by their place and their imports."""

    root: Path
    """The checkout."""

    @cached_property
    def exports(self) -> Mapping[tuple[str, str], str]:
        """The module that defines a name, by the package that exports it, and the name."""
        found = {}
        for file in self.root.glob(f"{SOURCE}/**/__init__.py"):
            package = module_name(file.relative_to(self.root))
            for module, name in imported_names(file.read_text(encoding="utf-8")):
                found[package, name] = module
        return found

    @cached_property
    def tests(self) -> Mapping[Path, frozenset[str]]:
        """All test files, relative to the checkout, with the modules that they or their helpers import."""
        files = sorted(self.root.glob("tests/**/test_*.py"))
        return {file.relative_to(self.root): self.modules(file) for file in files}

    def modules(self, file: Path) -> frozenset[str]:
        """The modules of calgraph that a file of tests imports, itself or by its helpers."""
        found: set[str] = set()
        seen: set[Path] = set()
        waiting = [file]
        while waiting:
            path = waiting.pop()
            seen.add(path)
            for module, name in imported_names(path.read_text(encoding="utf-8")):
                if module.split(".")[0] == "calgraph":
                    defining = self.exports.get((module, name), module)
                    found |= {defining, f"{defining}.{name}"}
                helpers = (self.root / folder / f"{module}.py" for folder in HELPERS)
                waiting += [helper for helper in helpers if helper.exists() and helper not in seen]
        return frozenset(found)

    def choose(self, file: Path) -> tuple[list[Path], list[Path]]:
        """Test files for a module: those that mirror it, and others; the most specific ones are first.

        Those that mirror it have its name, or are in the folder of its package and import it. Others import it,
        are in the folder of its package or of its room, or run whole commands.
        """
        place = Path("tests", *file.relative_to(SOURCE).parent.parts)
        room = Path("tests", file.relative_to(SOURCE).parts[0])
        module = module_name(file)

        def rank(test: Path) -> int:
            imports = module in self.tests[test]
            mirrors = test.parent == place and test.stem.startswith(f"test_{file.stem}")
            within = place in test.parents and place != Path("tests")
            commands = test.as_posix().startswith(WHOLE_COMMANDS)
            ranks = (mirrors, within and imports, imports, within, room in test.parents, commands)
            return ranks.index(True) if True in ranks else len(ranks)

        ranked = {test: rank(test) for test in self.tests}
        ordered = sorted((test for test in ranked if ranked[test] < 6), key=lambda test: (ranked[test], test))
        return [t for t in ordered if ranked[t] < 2], [t for t in ordered if ranked[t] >= 2]

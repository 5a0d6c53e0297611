"""Mutation test: which small faults in a room's source do its tests notice?

    make mutants ROOM=rig/pairs N=100 SEED=1 JOBS=4 TESTS=tests/end_to_end

``N`` places of the source are drawn with a seed, and one mutant of each: an operator, number, condition or loop
that is changed as cosmic-ray does (``mutation.py``). It is written into a copy of the checkout, where those tests
run first that execute the mutated line. The first test that fails kills the mutant, and so does the time limit; it
survives if all tests pass that execute any line of its file.

Not mutated: text, type annotations, decorators, imports, ``__all__``, ``zip(strict=...)``.
"""

import argparse
import ast
import difflib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from coverage import CoverageData

from mutation import Mutant, draw, find_mutants

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path("src/calgraph")
NOT_COPIED = (
    ".git", ".venv", ".*_cache", ".hypothesis", "__pycache__", "_build", "build", "dist", "demo", "gallery",
    "generated",
)  # fmt: skip

_LEAST_LIMIT = 30.0
"""Seconds that the tests of a mutant may take beyond five times what they take without it: imports and load."""
_STARTED_BY_TESTS = {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}

Outcome = Literal["killed", "timeout", "survived"]


@dataclass(frozen=True)
class Tests:
    """What a run of the tests on the unchanged source shows."""

    functions: tuple[str, ...]
    """All test functions, without parameters."""
    seconds: dict[str, float]
    by_line: dict[Path, dict[int, frozenset[str]]]
    """By file and line, the test functions during which the line was executed."""

    def touching(self, file: Path) -> frozenset[str]:
        """The test functions that execute any line of a file, beyond importing it."""
        return frozenset().union(*self.by_line.get(file, {}).values())

    def ordered(self, chosen: Iterable[str], file: Path) -> list[str]:
        """By file: the one that mirrors the mutated file first, then the quickest."""
        by_file: dict[str, list[str]] = defaultdict(list)
        for function in chosen:
            by_file[function.split("::")[0]].append(function)

        def rank(name: str) -> tuple[bool, float]:
            return Path(name).stem != f"test_{file.stem}", sum(self.seconds.get(f, 0.0) for f in by_file[name])

        return [function for name in sorted(by_file, key=rank) for function in sorted(by_file[name])]


def statement_lines(code: str, line: int) -> tuple[range, bool]:
    """Lines of the innermost statement or header at a line, and whether it runs when the module is imported."""
    best, imported = range(line, line + 1), True
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            body = node.body if isinstance(node.body, list) else [node.body]
            imported &= not body[0].lineno <= line <= (node.end_lineno or 0)
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", [])
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or node.lineno
            if node.lineno <= line <= last:
                best = range(node.lineno, last + 1)
    return best, imported


def copy_checkout(target: Path) -> None:
    """Copies what tests need, and compiles it."""
    shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*NOT_COPIED))
    # Bytecode that is valid by the hash of its source: files are changed within the resolution of time stamps.
    python = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash"]
    subprocess.run([*python, "src", "tests", "benchmarks"], cwd=target, check=True)


def run_pytest(checkout: Path, arguments: list[str], limit: float | None = None) -> tuple[int | None, str]:
    """Exit code, None at the time limit, and output of pytest in a copy of the checkout."""
    environment = os.environ | _STARTED_BY_TESTS | {
        "PYTHONPATH": str(checkout / "src"),
        "CALGRAPH_DATA": os.environ.get("CALGRAPH_DATA", str(ROOT.parent / "shared" / "data")),
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--hypothesis-seed=0", *arguments]
    command += [f"--basetemp={checkout / 'tmp'}"]
    process = subprocess.Popen(
        command, cwd=checkout, env=environment, text=True, start_new_session=True, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=limit)
        return process.returncode, output
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return None, ""
    finally:
        shutil.rmtree(checkout / ".hypothesis", ignore_errors=True)  # failing examples are for one mutant only


def measure(checkout: Path, tests: list[str], jobs: int) -> Tests:
    """Runs the tests on the unchanged source: which lines they execute, and how long they take."""
    measuring = ["--cov", "--cov-context=test", "--cov-report=", "--cov-fail-under=0", "--durations=0", "-vv"]
    code, output = run_pytest(checkout, [*measuring, "-n", str(jobs), "--dist=loadfile", *tests])
    if code:
        raise SystemExit(f"{output}\nThe tests fail without any mutant.")
    seconds: dict[str, float] = defaultdict(float)
    durations = r"^([\d.]+)s (?:call|setup|teardown) +(\S+?)(?:\[.*)?$"
    for duration, test in re.findall(durations, output, re.MULTILINE):
        seconds[test] += float(duration)
    data = CoverageData(str(checkout / ".coverage"))
    data.read()
    by_line = {}
    for file in data.measured_files():
        lines = data.contexts_by_lineno(file)
        named = {
            line: frozenset(re.split(r"[\[|]", c)[0] for c in contexts if c) for line, contexts in lines.items()
        }
        by_line[Path(file).relative_to(checkout)] = named
    functions = sorted(set().union(*(found for lines in by_line.values() for found in lines.values())))
    return Tests(tuple(functions), dict(seconds), by_line)


def judge(mutant: Mutant, original: str, tests: Tests, checkout: Path) -> Outcome:
    """Runs the tests that may kill a mutant: those of its line, then the others that execute its file.

    Fixtures and caches that tests share run in the first of them only, so the others count as well.
    """
    lines, imported = statement_lines(original, mutant.start[0])
    executed = tests.by_line.get(mutant.file, {})
    touching = tests.touching(mutant.file)
    first = touching if imported else frozenset().union(*(executed.get(line, frozenset()) for line in lines))
    files = {function.split("::")[0] for function in touching}
    then = {f for f in tests.functions if imported or f.split("::")[0] in files} - first
    (checkout / mutant.file).write_text(mutant.code(original), encoding="utf-8")
    try:
        for chosen in (first, then):
            if chosen:
                limit = _LEAST_LIMIT + 5 * sum(tests.seconds.get(function, 0.0) for function in chosen)
                code, output = run_pytest(checkout, ["-x", "-q", *tests.ordered(chosen, mutant.file)], limit)
                if code is None:
                    return "timeout"
                if code in (1, 2, 3, 4):  # 2 to 4: it cannot even be imported
                    return "killed"
                if code:
                    raise RuntimeError(f"pytest ended with {code} for {mutant}:\n{output}")
        return "survived"
    finally:
        (checkout / mutant.file).write_text(original, encoding="utf-8")


def sources_of(room: str) -> list[Path]:
    """Files of a room, of a part of it, or one file: relative to the checkout."""
    place = ROOT / SOURCE / room.removeprefix(f"{SOURCE}/").rstrip("/")
    if not place.exists():
        place = place.with_suffix(".py")
    if not place.exists():
        raise SystemExit(f"there is no {room} in {SOURCE}")
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [file.relative_to(ROOT) for file in files if file.name != "__init__.py"]


def tests_of(room: str) -> list[str]:
    """The folder or file of tests that mirrors a room."""
    name = Path(room.removeprefix(f"{SOURCE}/")).parts[0].removesuffix(".py")
    found = [place for place in (f"tests/{name}", f"tests/test_{name}.py") if (ROOT / place).exists()]
    if not found:
        raise SystemExit(f"no tests mirror {room}: name some with --tests")
    return found


def show(outcomes: list[tuple[Mutant, Outcome]], originals: dict[Path, str]) -> None:
    """Prints a table by file, and what each survivor changes."""
    for mutant, outcome in outcomes:
        if outcome == "survived":
            before, after = (
                text.splitlines() for text in (originals[mutant.file], mutant.code(originals[mutant.file]))
            )
            print(f"\n{mutant.file}:{mutant.start[0]} {mutant.operator} survived")
            print("\n".join(list(difflib.unified_diff(before, after, lineterm="", n=1))[2:]))
    print(f"\n{'file':<60} {'killed':>8} {'timeout':>8} {'survived':>8}")
    for file in [*originals, None]:
        count = Counter(outcome for mutant, outcome in outcomes if file in (None, mutant.file))
        if count:
            cells = " ".join(f"{count[key]:>8}" for key in ("killed", "timeout", "survived"))
            print(f"{file.relative_to(SOURCE).as_posix() if file else 'all':<60} {cells}")
    died = sum(outcome != "survived" for _, outcome in outcomes)
    print(f"\n{died} of {len(outcomes)} mutants die: {died / len(outcomes):.1%}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("rooms", nargs="+", metavar="ROOM", help="room, part of one, or file, below src/calgraph")
    parser.add_argument("-n", type=int, default=50, help="mutants to draw (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (%(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at a time (%(default)s)")
    parser.add_argument("--tests", nargs="*", default=[], help="tests besides those of the rooms")
    options = parser.parse_args()

    files = list(dict.fromkeys(file for room in options.rooms for file in sources_of(room)))
    tests = list(dict.fromkeys([*(place for room in options.rooms for place in tests_of(room)), *options.tests]))
    originals = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    possible = [mutant for file, code in originals.items() for mutant in find_mutants(file, code)]
    drawn = draw(originals, possible, options.n, np.random.default_rng(options.seed))
    print(f"{len(drawn)} of {len(possible)} mutants of {len(files)} files; tests: {' '.join(tests)}", flush=True)

    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        checkouts: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for job in range(options.jobs):
            copy_checkout(Path(folder, str(job)))
            checkouts.put(Path(folder, str(job)))
        measured = measure(Path(folder, "0"), tests, options.jobs)
        print(f"{len(measured.functions)} test functions, {sum(measured.seconds.values()):.0f} s", flush=True)

        def tried(mutant: Mutant) -> tuple[Mutant, Outcome]:
            checkout = checkouts.get()
            try:
                outcome = judge(mutant, originals[mutant.file], measured, checkout)
            finally:
                checkouts.put(checkout)
            print(f"{mutant.file}:{mutant.start[0]} {mutant.operator}: {outcome}", file=sys.stderr, flush=True)
            return mutant, outcome

        with ThreadPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(tried, drawn))
    show(outcomes, originals)


if __name__ == "__main__":
    main()

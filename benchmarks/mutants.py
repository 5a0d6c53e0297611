"""Mutation test: which small faults in the source do the tests notice?

    make mutants N=100 SEED=1 JOBS=4
    make mutants ROOM=rig/pairs N=100 SEED=1

``N`` places of the source, or of a room, are drawn with a seed, and one mutant of each: an operator, number,
condition or loop that is changed as cosmic-ray does (``mutation.py``). It is written into a copy of the checkout.
There the test files run that mirror its module or import it (``mutant_tests.py``), in two tiers: tests that are
not slow, and, of mutants that survive these, the slow ones. The first test that fails kills the mutant, if it
passes without it. Results are in a CSV file, one row a mutant; a run with the same arguments continues it.

Not mutated: text, type annotations, decorators, imports, ``__all__``, ``zip(strict=...)``.
"""

import argparse
import difflib
import hashlib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from mutant_tests import SOURCE, Selection
from mutation import Mutant, draw, find_mutants
from worlds import append_rows, read_rows

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = (
    ".git", ".venv", ".*_cache", ".hypothesis", "__pycache__", "_build", "build", "dist", "demo", "gallery",
    "generated",
)  # fmt: skip
LIMITS = {"first": 900.0, "slow": 1800.0}
"""s; time that the tests of a tier may take on one mutant."""
ARGUMENTS = {"first": ["-m", "not slow", "--timeout=60"], "slow": ["-m", "slow"]}
"""Of pytest, by tier; a loop without end is a test that fails."""
SURVIVED = {"first": "open", "slow": "survived"}
"""Outcome of a mutant that survives a tier."""
OUTCOMES = ("first", "slow", "survived", "open", "unfinished")
"""Died in the first tier, by a slow test, in neither; slow tests have not run; a tier did not end in time."""
_STARTED_BY_TESTS = {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}


@dataclass(frozen=True)
class Row:
    """What became of a mutant."""

    file: str
    line: int
    column: int
    operator: str
    occurrence: int
    source: str
    """Digest of the file that was mutated."""
    outcome: str = "new"
    test: str = ""
    """The one that failed."""
    seconds: float = 0.0
    """CPU time of all its tests."""


@dataclass
class Record:
    """The rows of a run, and their file, of which the last row of a mutant counts."""

    path: Path
    rows: dict[tuple[str, ...], Row] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @staticmethod
    def key(row: Row) -> tuple[str, ...]:
        """Identity of a mutant."""
        return tuple(str(value) for value in list(asdict(row).values())[:6])

    def load(self) -> None:
        """Reads the rows of an earlier run, of each mutant the last one."""
        self.rows |= {self.key(row): row for row in read_rows(Row, self.path)}

    def put(self, row: Row) -> None:
        """Adds or replaces a row, and appends it to the file."""
        with self.lock:
            self.rows[self.key(row)] = row
            append_rows(Row, [row], self.path)


def copy_checkout(target: Path) -> None:
    """Copies what tests need, and compiles it."""
    shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*NOT_COPIED))
    # Bytecode that is valid by the hash of its source: files are changed within the resolution of time stamps.
    python = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash"]
    subprocess.run([*python, "src", "tests", "benchmarks"], cwd=target, check=True)


@dataclass(frozen=True)
class Run:
    """How pytest ended."""

    code: int | None
    """Exit code, None at the time limit."""
    output: str
    seconds: float
    """CPU time, of its processes, too."""

    def failed(self) -> list[str]:
        """The test functions, or files, that failed."""
        places = re.findall(r"^(?:FAILED|ERROR) (tests/[^\s\[]+)", self.output, re.MULTILINE)
        return list(dict.fromkeys(places))


def run_pytest(checkout: Path, arguments: list[str], limit: float) -> Run:
    """Runs pytest in a copy of the checkout."""
    environment = os.environ | _STARTED_BY_TESTS | {
        "PYTHONPATH": str(checkout / "src"),
        "CALGRAPH_DATA": os.environ.get("CALGRAPH_DATA", str(ROOT.parent / "shared" / "data")),
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--hypothesis-seed=0", *arguments]
    command += [f"--basetemp={checkout / 'tmp'}"]
    log = checkout / "pytest.log"
    with log.open("wb") as out:
        process = subprocess.Popen(
            command, cwd=checkout, env=environment, start_new_session=True, stdin=subprocess.DEVNULL, stdout=out,
            stderr=subprocess.STDOUT,
        )  # fmt: skip
    end, killed = time.monotonic() + limit, False
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        if time.monotonic() > end and not killed:
            os.killpg(process.pid, signal.SIGKILL)
            killed = True
        time.sleep(0.05)
    process.returncode = os.waitstatus_to_exitcode(status)
    shutil.rmtree(checkout / ".hypothesis", ignore_errors=True)  # failing examples are for one mutant only
    output = log.read_text(encoding="utf-8", errors="replace")
    return Run(None if killed else process.returncode, output, usage.ru_utime + usage.ru_stime)


def judge(row: Row, tier: str, code: str, tests: list[Path], left_out: set[str], checkout: Path) -> Row:
    """Runs the tests of a tier on a mutant, and on the unchanged source those that fail.

    Those that fail there, too, are added to `left_out`, and the others run again.
    """
    file = checkout / row.file
    original = file.read_text(encoding="utf-8")
    seconds = row.seconds
    while True:
        known = sorted(left_out)
        deselected = [f"--deselect={test}" for test in known]
        chosen = [str(test) for test in tests if str(test) not in known]
        if not chosen:
            return replace(row, outcome=SURVIVED[tier], seconds=seconds)
        file.write_text(code, encoding="utf-8")
        try:
            run = run_pytest(checkout, ["-x", "-q", *ARGUMENTS[tier], *deselected, *chosen], LIMITS[tier])
        finally:
            file.write_text(original, encoding="utf-8")
        seconds += run.seconds
        if run.code is None:
            return replace(row, outcome="unfinished", seconds=seconds)
        if run.code in (0, 5):  # 5: the tier has no tests here
            return replace(row, outcome=SURVIVED[tier], seconds=seconds)
        failed = run.failed() or chosen
        check = run_pytest(checkout, ["-x", "-q", *ARGUMENTS[tier], *failed], LIMITS[tier])
        seconds += check.seconds
        if check.code in (0, 5):
            return replace(row, outcome=tier, test=failed[0], seconds=seconds)
        if set(failed) <= set(known) or not run.failed():
            raise RuntimeError(f"tests fail without the mutant, too:\n{check.output}")
        left_out.update(failed)


def sources_of(room: str) -> list[Path]:
    """Files of a room, of a part of it, or one file: relative to the checkout."""
    place = ROOT / SOURCE / room.removeprefix(f"{SOURCE}/").rstrip("/")
    if not place.exists():
        place = place.with_suffix(".py")
    if not place.exists():
        raise SystemExit(f"there is no {room} in {SOURCE}")
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [file.relative_to(ROOT) for file in files if file.name != "__init__.py"]


def show(rows: dict[Mutant, Row], originals: dict[Path, str]) -> None:
    """Prints what each survivor changes, a table by room, and the shares that die."""
    for mutant, row in rows.items():
        if row.outcome in ("survived", "open", "unfinished"):
            before, after = (
                text.splitlines() for text in (originals[mutant.file], mutant.code(originals[mutant.file]))
            )
            print(f"\n{mutant.file}:{mutant.start[0]} {mutant.operator} {row.outcome}")
            print("\n".join(list(difflib.unified_diff(before, after, lineterm="", n=1))[2:]))
    tried = [row for row in rows.values() if row.outcome in OUTCOMES]
    print(f"\n{'room':<20}" + "".join(f"{key:>11}" for key in OUTCOMES))
    for room in [*sorted({Path(row.file).parts[2] for row in tried}), "all"]:
        count = Counter(row.outcome for row in tried if room in ("all", Path(row.file).parts[2]))
        print(f"{room:<20}" + "".join(f"{count[key]:>11}" for key in OUTCOMES))
    first, slow = (sum(row.outcome == tier for row in tried) for tier in ("first", "slow"))
    share = 100 / max(1, len(tried))
    minutes = sum(row.seconds for row in tried) / 60
    print(
        f"\nOf {len(tried)} mutants, {first} die in the first tier ({first * share:.1f} %), {slow} by slow tests"
    )
    print(f"({(first + slow) * share:.1f} % in both); {minutes:.1f} min of CPU.")


def try_all(
    rows: dict[Mutant, Row], record: Record, originals: dict[Path, str], options: argparse.Namespace
) -> None:
    """Runs both tiers, the slow one on what survives the first, until the CPU time is used up."""
    selection = Selection(ROOT)
    used = [0.0]
    left_out = set(options.leave_out)
    checkouts: queue.SimpleQueue[Path] = queue.SimpleQueue()

    def attempt(mutant: Mutant, tier: str) -> None:
        if used[0] > 60 * options.cpu_minutes:
            return
        checkout = checkouts.get()
        row = rows[mutant]
        near, others = selection.choose(mutant.file)
        code = mutant.code(originals[mutant.file])
        try:
            # Most mutants die by the tests of their module, which are collected in no time.
            done = judge(row, tier, code, near, left_out, checkout)
            if done.outcome == SURVIVED[tier]:
                others = list(dict.fromkeys([*others, *map(Path, options.tests)]))
                done = judge(done, tier, code, others, left_out, checkout)
        finally:
            checkouts.put(checkout)
        used[0] += done.seconds - row.seconds
        rows[mutant] = done
        record.put(done)
        place = f"{mutant.file}:{mutant.start[0]} {mutant.operator}"
        print(
            f"{place}: {tier} tier: {done.outcome} {done.test} {done.seconds:.0f} s", file=sys.stderr, flush=True
        )

    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        for job in range(options.jobs):
            copy_checkout(Path(folder, str(job)))
            checkouts.put(Path(folder, str(job)))
        for tier, before in (("first", "new"), ("slow", "open")):
            waiting = [mutant for mutant, row in rows.items() if row.outcome == before]
            with ThreadPoolExecutor(options.jobs) as pool:
                list(pool.map(lambda mutant, tier=tier: attempt(mutant, tier), waiting))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help="room, part, or file below src/calgraph (all)")
    parser.add_argument("-n", type=int, default=50, help="mutants to draw (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (%(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at a time (%(default)s)")
    parser.add_argument("--tests", nargs="*", default=[], help="tests besides those of each module")
    parser.add_argument("--leave-out", nargs="*", default=[], help="tests that fail without any mutant")
    parser.add_argument("--cpu-minutes", type=float, default=float("inf"), help="time after which no test starts")
    parser.add_argument("--out", type=Path, help="CSV file of the results (build/mutants/SEED.csv)")
    options = parser.parse_args()

    files = list(dict.fromkeys(file for room in options.rooms or ["."] for file in sources_of(room)))
    originals = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    possible = [mutant for file, code in originals.items() for mutant in find_mutants(file, code)]
    rng = np.random.default_rng(options.seed)
    drawn = draw(originals, possible, options.n, rng)
    print(f"{len(drawn)} of {len(possible)} mutants of {len(files)} files, seed {options.seed}", flush=True)

    record = Record(options.out or ROOT / f"build/mutants/{options.seed}.csv")
    record.load()
    digests = {file: hashlib.sha256(code.encode()).hexdigest()[:12] for file, code in originals.items()}
    rows = {}
    # In random order: those that are tried before the time is used up are a sample of all.
    for mutant in (drawn[k] for k in rng.permutation(len(drawn))):
        place = (mutant.file.as_posix(), *mutant.start, mutant.operator, mutant.occurrence, digests[mutant.file])
        row = Row(*place)
        rows[mutant] = record.rows.get(Record.key(row), row)
    try_all(rows, record, originals, options)
    show(rows, originals)


if __name__ == "__main__":
    main()

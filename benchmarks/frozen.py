"""A frozen corpus of calibration problems: their results with every bit, before and after a change of the source.

python benchmarks/frozen.py                               # all problems, into build/frozen/current
python benchmarks/frozen.py --out build/frozen/before     # into another folder; it resumes what is there
python benchmarks/frozen.py --every 10                    # each tenth problem
python benchmarks/frozen.py --only 'networks/*' --force   # some problems, again
python benchmarks/frozen.py --list                        # names alone
python benchmarks/frozen.py compare build/frozen/before build/frozen/current

Prints a line for each problem: name, SHA-256 of its text, CPU seconds (``-`` where it was there); then totals:

    model_errors/five/print_scale/0.01/0 dc1681ddae28 1.94
    435 problems, digest d8e7b5fceb20, 1097 s of CPU, 1180 s

``compare`` prints how many problems are equal, and what changed in the others. Its exit code is 1 if any differs:

    model_errors/five/print_scale/0.01/0
        sensors/lidar/verdict/grade: "good" -> "weak"
        sensors/lidar: moved by 0.31 sigma, 0.52 mm; sigmas times 1.02 to 1.4
        rejected now: 1 views: 4/lidar
    434 of 435 problems are equal

A problem is a pure function of its name: seeds are part of it. Its text (frozen_texts.py) has poses, covariances,
clocks, verdicts, remarks, systematic parameters, and which views were used, or the error that refused it. Problems
are those of frozen_rigs.py, frozen_networks.py and frozen_recordings.py. Equal bits need OMP_NUM_THREADS=1, as
``make frozen`` sets it, and one machine: libraries choose instructions by processor.
"""

import argparse
import hashlib
import logging
import os
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import cv2

from calgraph.parallel.engine import Processes
from frozen_differences import compare
from frozen_networks import list_network_problems
from frozen_recordings import MissingDataError, list_recording_problems
from frozen_rigs import Make, list_rig_problems
from frozen_texts import describe, describe_error
from worlds import make_parser

SHOWN = 12
"""Digits of a SHA-256."""


def main() -> None:
    """Calculates problems, or compares two folders."""
    if sys.argv[1:2] == ["compare"]:
        parser = argparse.ArgumentParser(prog="frozen.py compare", description="What differs between two folders.")
        parser.add_argument("folders", nargs=2, type=Path)
        sys.exit(0 if compare(*parser.parse_args(sys.argv[2:]).folders) else 1)
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/frozen/current"))
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--only", nargs="+", default=["*"], metavar="PATTERN", help="names of problems")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th of these")
    parser.add_argument("--force", action="store_true", help="calculate what is there again")
    parser.add_argument("--list", action="store_true", help="print names alone")
    arguments = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        print("OMP_NUM_THREADS is not 1: bits may differ from run to run", file=sys.stderr)
    names = select(list(list_problems()), arguments.only, arguments.every)
    if arguments.list:
        print("\n".join(names))
        return
    run_all(names, arguments.out, arguments.jobs, force=arguments.force)


@cache
def list_problems() -> Mapping[str, Make]:
    """All problems by name."""
    problems: dict[str, Make] = {}
    for source in (list_rig_problems, list_network_problems, list_recording_problems):
        for name, make in source():
            assert name not in problems, name
            problems[name] = make
    return problems


def select(names: Sequence[str], patterns: Sequence[str], every: int) -> list[str]:
    """Each ``every``-th of the names that match one of the patterns."""
    return [name for name in names if any(fnmatch(name, pattern) for pattern in patterns)][::every]


def run_all(names: Sequence[str], out: Path, jobs: int, *, force: bool) -> None:
    """Calculates problems that are not in the folder, and prints a line for each, and totals."""
    began, cpu, found = time.monotonic(), 0.0, []
    work = [(name, out, force) for name in names]
    for name, digest, seconds in Processes(jobs).map(calculate, work):
        if not digest:
            continue
        found.append(f"{name} {digest}\n")
        cpu += seconds or 0.0
        print(f"{name} {digest[:SHOWN]} {'-' if seconds is None else f'{seconds:.2f}'}", flush=True)
    total = hashlib.sha256("".join(sorted(found)).encode()).hexdigest()
    print(f"{len(found)} problems, digest {total[:SHOWN]}, {cpu:.0f} s of CPU, {time.monotonic() - began:.0f} s")


def prepare() -> None:
    """What a process does before it calculates problems."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    cv2.setNumThreads(1)


def calculate(name: str, out: Path, force: bool) -> tuple[str, str, float | None]:
    """Name, digest and CPU seconds of a problem, None where its text was in the folder; writes the text.

    The digest is empty where a real recording is missing.
    """
    prepare()
    path = out / f"{name}.txt"
    if path.exists() and not force:
        return name, hashlib.sha256(path.read_bytes()).hexdigest(), None
    began = time.process_time()
    try:
        text = describe(list_problems()[name]())
    except MissingDataError as error:
        print(f"{name} skipped: {error}", file=sys.stderr)
        return name, "", None
    except Exception as error:
        text = describe_error(error)
    seconds = time.process_time() - began
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(f".{os.getpid()}")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)
    return name, hashlib.sha256(text.encode()).hexdigest(), seconds


if __name__ == "__main__":
    main()

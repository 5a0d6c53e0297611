"""What calgraph answers to damaged input and to faults of the computer: the tables of docs/reliability.md.

python benchmarks/reliability.py --jobs 4                      # all tables
python benchmarks/reliability.py --tables recordings --seeds 2 # some of them, with fewer seeds
python benchmarks/reliability.py --only "cut off" --keep wrong # some kinds; inputs of wrong answers are kept

Each input or fault is one run of the installed command line in a separate folder.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from reliability_bags import Source, simulate_source
from reliability_cases import Case, Outcome, attempt_all
from reliability_documents import FILE_TABLE, RIG_TABLE, list_files, list_rigs, write_documents
from reliability_interrupts import SWEEP_TABLE, References, list_operations
from reliability_interrupts import TABLE as SIGNAL_TABLE
from reliability_interrupts import list_cases as list_signals
from reliability_lines import TABLE as LINE_TABLE
from reliability_lines import list_cases as list_lines
from reliability_recordings import TABLE as RECORDING_TABLE
from reliability_recordings import list_cases as list_recordings
from reliability_recordings import write_forms
from reliability_system import TABLE as FAULT_TABLE
from reliability_system import list_cases as list_faults
from reliability_tables import ANSWERS, STATES, Columns, describe_wrong, format_section


def main() -> None:
    """Prints the tables, and the wrong answers; exit code 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--seeds", type=int, default=6, help="of each kind and form")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of wrong answers")
    arguments = parser.parse_args()
    outcomes: list[Outcome] = []
    began = time.monotonic()
    with TemporaryDirectory(prefix="reliability ") as scratch:
        source = simulate_source(Path(scratch) / "source", seed=0)
        for table in arguments.tables:
            cases = [
                case
                for case in TABLES[table](source, Path(scratch), arguments.seeds)
                if arguments.only in case.name
            ]
            found = attempt_all(cases, Path(scratch) / "cases", arguments.jobs, arguments.keep, _show_wrong)
            outcomes += found
            if found:
                print(f"\n{format_section(found, *_LAYOUTS[table])}\n", flush=True)
    wrong = describe_wrong(outcomes)
    print(f"{len(outcomes)} in {time.monotonic() - began:.0f} s; wrong:{chr(10) if wrong else ' none'}{wrong}")
    sys.exit(1 if wrong else 0)


def _show_wrong(outcome: Outcome) -> None:
    if outcome.judged.answer.is_wrong:
        print(
            f"WRONG {outcome.case.name}: {outcome.judged.answer.value}: {outcome.judged.detail}",
            file=sys.stderr, flush=True,
        )  # fmt: skip


def _recordings(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    _documents(source, scratch)
    return list_recordings(source, write_forms(source, scratch / "forms"), seeds)


def _rigs(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return list_rigs(source, _documents(source, scratch), seeds)


def _files(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return list_files(source, _documents(source, scratch), seeds)


def _lines(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return list_lines(source, _documents(source, scratch), seeds)


def _signals(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return list_signals(References(_documents(source, scratch)).measure(scratch / "signals"), seeds)


def _operations(source: Source, scratch: Path, _seeds: int) -> Iterator[Case]:
    references = References(_documents(source, scratch)).measure(scratch / "operations")
    return list_operations(references, scratch / "operations")


def _faults(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return list_faults(source, References(_documents(source, scratch)).measure(scratch / "faults"), seeds)


def _documents(source: Source, scratch: Path) -> Path:
    folder = scratch / "documents"
    return folder if folder.exists() else write_documents(source, folder)


_LAYOUTS: Mapping[str, tuple[Sequence[str], Columns]] = {
    RECORDING_TABLE: (("damage", "form of the recording"), ANSWERS),
    RIG_TABLE: (("mutation", "rig"), ANSWERS),
    FILE_TABLE: (("mutation", "file"), ANSWERS),
    LINE_TABLE: (("argument", "place"), ANSWERS),
    SIGNAL_TABLE: (("signal", "command"), STATES),
    SWEEP_TABLE: (("signal", "command"), STATES),
    FAULT_TABLE: (("fault", "command"), ANSWERS),
}
"""The heads of the first columns, and the other columns."""
TABLES: Mapping[str, Callable[[Source, Path, int], Iterator[Case]]] = {
    RECORDING_TABLE: _recordings,
    RIG_TABLE: _rigs,
    FILE_TABLE: _files,
    LINE_TABLE: _lines,
    SIGNAL_TABLE: _signals,
    SWEEP_TABLE: _operations,
    FAULT_TABLE: _faults,
}


if __name__ == "__main__":
    main()

"""What calgraph answers to damaged input and to faults of the computer: the tables of docs/reliability.md.

python benchmarks/reliability.py --jobs 4                      # all tables
python benchmarks/reliability.py --tables recordings --seeds 2 # some of them, with fewer seeds
python benchmarks/reliability.py --only "cut off" --keep wrong # some kinds; inputs of wrong answers are kept

Each input or fault is one run of the installed command line in a folder of its own.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from reliability_bags import Source, simulate_source
from reliability_cases import Case, Outcome, attempt_all
from reliability_recordings import list_cases as list_recordings
from reliability_recordings import write_forms
from reliability_tables import describe_wrong, format_table


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
                print(f"\n{format_table(found, table, lambda one: one.case.kind)}\n", flush=True)
                print(f"{format_table(found, 'form', lambda one: one.case.form)}\n", flush=True)
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
    forms = write_forms(source, scratch / "forms")
    return list_recordings(source, forms, seeds)


TABLES: Mapping[str, Callable[[Source, Path, int], Iterator[Case]]] = {"recordings": _recordings}


if __name__ == "__main__":
    main()

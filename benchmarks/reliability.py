"""What calgraph answers to damaged input and to faults of the computer: the tables of docs/reliability.md.

python benchmarks/reliability.py --jobs 4                      # all tables
python benchmarks/reliability.py --tables recordings --seeds 2 # some of them, with fewer seeds
python benchmarks/reliability.py --only "cut off" --keep wrong # some kinds; inputs of wrong answers are kept
python benchmarks/reliability.py --outcomes FILE --minutes 30  # half an hour of them; the next run continues

Each input or fault is one run of the installed command line in a separate folder.
"""

import argparse
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import reliability_caches as caches
import reliability_documents as documents
import reliability_interrupts as interrupts
import reliability_lines as lines
import reliability_media as media
import reliability_recordings as recordings
import reliability_system as system
from reliability_bags import FORMS, Source, simulate_source
from reliability_cases import Case, Outcome, attempt_all, in_order, load_outcomes, save_outcome
from reliability_mutations import YAML_MUTATIONS
from reliability_tables import ANSWERS, STATES, Columns, describe_wrong, format_section


@dataclass(frozen=True)
class Table:
    """Two tables of one section of the page, by kind and by form."""

    heads: tuple[str, str]
    columns: Columns
    kinds: Collection[str]
    forms: Collection[str]
    list_cases: Callable[[Source, Path, int], Iterable[Case]]


def main() -> None:
    """Prints the tables, and the wrong answers; exit code 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--seeds", type=int, default=2, help="of each kind and form; some tables have multiples")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="no case is begun later; 0 prints only")
    parser.add_argument("--outcomes", type=Path, help="file of outcomes, which are not repeated")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of wrong answers")
    arguments = parser.parse_args()
    outcomes = list(load_outcomes(arguments.outcomes)) if arguments.outcomes else []

    def report(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if arguments.outcomes:
            save_outcome(outcome, arguments.outcomes)
        if outcome.judged.answer.is_wrong:
            print("WRONG", describe_wrong([outcome]), file=sys.stderr, flush=True)

    end = time.monotonic() + 60 * arguments.minutes
    if arguments.minutes:
        known = {outcome.name for outcome in outcomes}
        with TemporaryDirectory(prefix="reliability ") as name:
            scratch = Path(name)
            source = simulate_source(scratch / "source", seed=0)
            for table in arguments.tables:
                listed = TABLES[table].list_cases(source, scratch, arguments.seeds)
                cases = [case for case in listed if arguments.only in case.name and case.name not in known]
                attempt_all(cases, scratch / "cases", arguments.jobs, arguments.keep, report, end)
    for table in arguments.tables:
        layout = TABLES[table]
        rows = list(in_order([one for one in outcomes if one.table == table], layout.kinds, layout.forms))
        if rows:
            print(f"{format_section(rows, layout.heads, layout.columns)}\n")
    wrong = describe_wrong(outcomes)
    print(f"{len(outcomes)} cases; wrong:{chr(10) if wrong else ' none'}{wrong}")
    sys.exit(1 if wrong else 0)


def _documents(source: Source, scratch: Path) -> Path:
    folder = scratch / "documents"
    return folder if folder.exists() else documents.write_documents(source, folder)


def _references(source: Source, scratch: Path, name: str) -> interrupts.References:
    return interrupts.References(_documents(source, scratch)).measure(scratch / name)


def _list_recordings(source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    _documents(source, scratch)  # of which check compares one with the recordings
    return recordings.list_cases(source, recordings.write_forms(source, scratch / "forms"), seeds)


TABLES: Mapping[str, Table] = {
    recordings.TABLE: Table(
        ("damage of the recording", "form of the recording"), ANSWERS, recordings.KINDS, FORMS, _list_recordings
    ),
    media.TABLE: Table(
        ("damage of another recording", "form of another recording"),
        ANSWERS,
        media.KINDS,
        media.FORMS,
        lambda source, scratch, seeds: media.list_cases(
            source, media.write_media(source, scratch / "media"), seeds
        ),
    ),
    documents.RIG_TABLE: Table(
        ("mutation of the rig", "form of the rig"),
        ANSWERS,
        YAML_MUTATIONS,
        documents.RIGS,
        lambda source, scratch, seeds: documents.list_rigs(source, _documents(source, scratch), seeds),
    ),
    documents.FILE_TABLE: Table(
        ("mutation of another file", "file"),
        ANSWERS,
        documents.FILE_KINDS,
        [one.name for one in documents.DOCUMENTS],
        lambda source, scratch, seeds: documents.list_files(source, _documents(source, scratch), seeds),
    ),
    lines.TABLE: Table(
        ("argument", "place"),
        ANSWERS,
        lines.KINDS,
        lines.PLACES,
        lambda source, scratch, _: lines.list_cases(source, _documents(source, scratch)),
    ),
    system.TABLE: Table(
        ("fault", "command"),
        ANSWERS,
        system.FAULTS,
        system.TASK_NAMES,
        lambda source, scratch, _: system.list_cases(source, _references(source, scratch, "faults")),
    ),
    caches.TABLE: Table(
        ("state of the cache", "command with a cache"),
        ANSWERS,
        caches.KINDS,
        caches.COMMANDS,
        lambda source, scratch, seeds: caches.list_cases(
            source, caches.Kept(_documents(source, scratch), scratch / "caches").make(), seeds
        ),
    ),
    interrupts.TABLE: Table(
        ("signal at a random time", "command"),
        STATES,
        interrupts.KINDS,
        [task.name for task in interrupts.TASKS],
        lambda source, scratch, seeds: interrupts.list_cases(_references(source, scratch, "signals"), seeds),
    ),
    interrupts.SWEEP_TABLE: Table(
        ("signal", "command"),
        STATES,
        [interrupts.SWEEP_TABLE],
        [task.name for task in interrupts.TASKS],
        lambda source, scratch, _: interrupts.list_operations(_references(source, scratch, "sweep"), scratch),
    ),
}


if __name__ == "__main__":
    main()

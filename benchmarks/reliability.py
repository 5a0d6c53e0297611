"""What calgraph answers to failed sensors, signals and faults of the computer: the tables of docs/reliability.md.

python benchmarks/reliability.py --jobs 4                      # all tables
python benchmarks/reliability.py --tables recordings --seeds 2 # some of them, with fewer seeds
python benchmarks/reliability.py --only "stamps" --keep wrong  # some kinds; inputs of wrong answers are kept
python benchmarks/reliability.py --outcomes FILE --minutes 30  # half an hour of them; the next run continues

Each input or fault is one run of the installed command line in a separate folder. Bytes that are damaged are the
matter of fuzz_readers.py.
"""

import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import reliability_faults as faults
import reliability_recordings as recordings
import reliability_signals as signals
from reliability_answers import Answer
from reliability_bags import FORMS, Source, simulate_source
from reliability_cases import Case, Outcome, attempt_all
from reliability_messages import MESSAGE_DAMAGE
from reliability_tasks import EARLIER, NEW, NOTHING, TASKS, References, write_documents
from worlds import append_rows, grouped, make_parser, read_rows

Columns = Sequence[tuple[str, Callable[[Outcome], bool]]]


def _has_answer(*answers: Answer) -> Callable[[Outcome], bool]:
    return lambda one: one.judged.answer in answers


def _has_state(state: str) -> Callable[[Outcome], bool]:
    return lambda one: not one.judged.answer.is_wrong and one.judged.detail == state


ANSWERS: Columns = (
    ("tried", lambda _: True),
    ("right", _has_answer(Answer.RIGHT)),
    ("weak", _has_answer(Answer.WEAK)),
    ("refused", _has_answer(Answer.REFUSED)),
    ("wrong", lambda one: one.judged.answer.is_wrong),
)
"""Of damaged input."""
STATES: Columns = (
    ("tried", lambda _: True),
    *((state, _has_state(state)) for state in (signals.NOT_HIT, NOTHING, EARLIER, NEW)),
    ("lost", lambda one: one.judged.answer.is_wrong),
)
"""Of signals: what is there afterwards."""


@dataclass(frozen=True)
class Table:
    """Two tables of one section of the page, by kind and by form."""

    heads: tuple[str, str]
    columns: Columns
    kinds: Collection[str]
    forms: Collection[str]
    list_cases: Callable[[Source, Path, int], Iterable[Case]]

    def format(self, outcomes: Sequence[Outcome]) -> str:
        """Both tables in Markdown, with rows in the order of kinds and forms, and their sum."""
        rank = {name: number for number, name in enumerate([*self.kinds, *self.forms])}
        ordered = sorted(outcomes, key=lambda one: (rank.get(one.kind, 0), rank.get(one.form, 0), one.name))
        by_kind = format_table(ordered, self.heads[0], lambda one: one.kind, self.columns)
        return f"{by_kind}\n\n{format_table(ordered, self.heads[1], lambda one: one.form, self.columns)}"


def main() -> None:
    """Prints the tables, and the wrong answers; exit code 1 if there are any."""
    parser = make_parser(__doc__)
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--seeds", type=int, default=2, help="of each kind and form; some tables have multiples")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="no case is begun later; 0 prints only")
    parser.add_argument("--outcomes", type=Path, help="CSV file of outcomes, which are not repeated")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of wrong answers")
    arguments = parser.parse_args()
    outcomes = list({one.name: one for one in read_rows(Outcome, arguments.outcomes)}.values())

    def report(outcome: Outcome) -> None:
        outcomes.append(outcome)
        append_rows(Outcome, [outcome], arguments.outcomes)
        if outcome.judged.answer.is_wrong:
            print("WRONG", describe_wrong([outcome]), file=sys.stderr, flush=True)

    end = time.monotonic() + 60 * arguments.minutes
    if arguments.minutes:
        known = {outcome.name for outcome in outcomes}
        with TemporaryDirectory(prefix="reliability ") as name:
            scratch = Path(name)
            source = simulate_source(scratch / "source", seed=0)
            write_documents(source, scratch / "documents")
            for table in arguments.tables:
                listed = TABLES[table].list_cases(source, scratch, arguments.seeds)
                cases = [case for case in listed if arguments.only in case.name and case.name not in known]
                attempt_all(cases, scratch / "cases", arguments.jobs, arguments.keep, report, end)
    for table in arguments.tables:
        if rows := [one for one in outcomes if one.table == table]:
            print(f"{TABLES[table].format(rows)}\n")
    wrong = describe_wrong(outcomes)
    print(f"{len(outcomes)} cases; wrong:{chr(10) if wrong else ' none'}{wrong}")
    sys.exit(1 if wrong else 0)


def format_table(outcomes: Sequence[Outcome], head: str, key: Callable[[Outcome], str], columns: Columns) -> str:
    """A Markdown table with a row for each key, and their sum."""
    rows = [f"| {head} | {' | '.join(name for name, _ in columns)} |"]
    rows.append(f"| --- |{' ---: |' * len(columns)}")
    for name, group in [*grouped(outcomes, key), ("**all**", list(outcomes))]:
        rows.append(f"| {name} | {' | '.join(str(sum(map(test, group))) for _, test in columns)} |")
    return "\n".join(rows)


def describe_wrong(outcomes: Iterable[Outcome]) -> str:
    """A line for each wrong answer; empty if there is none."""
    return "\n".join(
        f"- {one.name}: {one.judged.answer.value}: {one.judged.detail}"
        for one in outcomes
        if one.judged.answer.is_wrong
    )


def _list_faults(source: Source, scratch: Path, _seeds: int) -> Iterator[Case]:
    return faults.list_cases(source, References(scratch / "documents").measure(scratch / "faults"))


def _list_signals(_source: Source, scratch: Path, seeds: int) -> Iterator[Case]:
    return signals.list_cases(References(scratch / "documents").measure(scratch / "signals"), seeds)


TABLES: Mapping[str, Table] = {
    recordings.TABLE: Table(
        ("damage of the recording", "form of the recording"),
        ANSWERS,
        MESSAGE_DAMAGE,
        FORMS,
        lambda source, _scratch, seeds: recordings.list_cases(source, seeds),
    ),
    faults.TABLE: Table(("fault", "command"), ANSWERS, faults.FAULTS, faults.TASK_NAMES, _list_faults),
    signals.TABLE: Table(
        ("signal at a random time", "command"), STATES, signals.KINDS, [task.name for task in TASKS], _list_signals
    ),
}


if __name__ == "__main__":
    main()

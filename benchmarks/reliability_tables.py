"""The tables of docs/reliability.md."""

from collections.abc import Callable, Iterable, Mapping, Sequence

from outcome_tables import grouped
from reliability_answers import Answer
from reliability_cases import Outcome
from reliability_interrupts import EARLIER, NEW, NOT_HIT, NOTHING

Columns = Sequence[tuple[str, Callable[[Outcome], bool]]]


def _has_state(state: str) -> Callable[[Outcome], bool]:
    return lambda one: not one.judged.answer.is_wrong and one.judged.detail == state


ANSWERS: Columns = (
    ("tried", lambda _: True),
    ("right", lambda one: one.judged.answer is Answer.RIGHT),
    ("weak", lambda one: one.judged.answer is Answer.WEAK),
    ("refused", lambda one: one.judged.answer is Answer.REFUSED),
    ("wrong", lambda one: one.judged.answer.is_wrong),
)
"""Of damaged input."""
STATES: Columns = (
    ("tried", lambda _: True),
    *((state, _has_state(state)) for state in (NOT_HIT, NOTHING, EARLIER, NEW)),
    ("lost", lambda one: one.judged.answer.is_wrong),
)
"""Of signals: what is there afterwards."""


def format_table(outcomes: Sequence[Outcome], head: str, key: Callable[[Outcome], str], columns: Columns) -> str:
    """A Markdown table with a row for each key, and their sum."""
    rows = [f"| {head} | {' | '.join(name for name, _ in columns)} |"]
    rows.append(f"| --- |{' ---: |' * len(columns)}")
    for name, group in [*grouped(outcomes, key), ("**all**", list(outcomes))]:
        rows.append(f"| {name} | {' | '.join(str(sum(map(test, group))) for _, test in columns)} |")
    return "\n".join(rows)


def format_section(outcomes: Sequence[Outcome], heads: Sequence[str], columns: Columns) -> str:
    """The tables of one section of the page: by kind of damage or fault, and by what it was done to."""
    keys: Mapping[str, Callable[[Outcome], str]] = {heads[0]: lambda one: one.kind, heads[1]: lambda one: one.form}
    return "\n\n".join(format_table(outcomes, head, key, columns) for head, key in keys.items())


def describe_wrong(outcomes: Iterable[Outcome]) -> str:
    """A line for each wrong answer; empty if there is none."""
    return "\n".join(
        f"- {one.name}: {one.judged.answer.value}: {one.judged.detail}"
        for one in outcomes
        if one.judged.answer.is_wrong
    )

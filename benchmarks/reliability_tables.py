"""The tables of docs/reliability.md."""

from collections.abc import Callable, Iterable, Sequence

from outcome_tables import grouped
from reliability_answers import Answer
from reliability_cases import Outcome

_COLUMNS: Sequence[tuple[str, Callable[[Outcome], bool]]] = (
    ("inputs", lambda _: True),
    ("right", lambda one: one.judged.answer is Answer.RIGHT),
    ("doubted", lambda one: one.judged.answer is Answer.DOUBTED),
    ("refused", lambda one: one.judged.answer is Answer.REFUSED),
    ("**wrong**", lambda one: one.judged.answer.is_wrong),
)


def format_table(outcomes: Sequence[Outcome], head: str, key: Callable[[Outcome], str]) -> str:
    """A Markdown table with a row for each key, and their sum."""
    rows = [f"| {head} | {' | '.join(name for name, _ in _COLUMNS)} |"]
    rows.append(f"| --- |{' ---: |' * len(_COLUMNS)}")
    for name, group in [*grouped(outcomes, key), ("all", list(outcomes))]:
        rows.append(f"| {name} | {' | '.join(str(sum(map(test, group))) for _, test in _COLUMNS)} |")
    return "\n".join(rows)


def describe_wrong(outcomes: Iterable[Outcome]) -> str:
    """A line for each wrong answer; empty if there is none."""
    return "\n".join(
        f"- {one.case.name}: {one.judged.answer.value}: {one.judged.detail}"
        for one in outcomes
        if one.judged.answer.is_wrong
    )

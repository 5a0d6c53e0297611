"""What contradicts a result, and reasons of verdicts as clauses: what several sensors share is stated once."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that contradicts a result: a remark on it."""

    text: str
    """Cause, size, and what to do, in one sentence."""
    sensors: tuple[str, ...] = ()
    """Sensors whose poses it makes weak."""
    refutes: bool = False
    """Whether it refutes the model of the joint solution, so that another estimate has to replace it."""


def split_clauses(reason: str) -> list[str]:
    """The clauses of a reason, which semicolons separate."""
    return reason.split("; ")


def share_clauses(reasons: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Separates the clauses that reasons share, for a list of them that states each once.

    Args:
        reasons: by sensor, or by sensors that have the same one.

    Returns:
        The clauses that each sensor has alone, then the marks of those that it shares, ``[1]``; and by mark, the
        clauses that the same sensors share.
    """
    owners: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        for clause in dict.fromkeys(split_clauses(reason)):
            owners.setdefault(clause, []).append(name)
    groups = dict.fromkeys(tuple(names) for names in owners.values() if len(names) > 1)
    marks = {names: f"[{n}]" for n, names in enumerate(groups, start=1)}
    stated = {}
    for name, reason in reasons.items():
        own = [clause for clause in split_clauses(reason) if owners[clause] == [name]]
        of_name = " and ".join(mark for names, mark in marks.items() if name in names)
        stated[name] = "; ".join([*own, *([f"see {of_name}"] if of_name else [])])
    shared = {
        mark: "; ".join(clause for clause, of in owners.items() if tuple(of) == names)
        for names, mark in marks.items()
    }
    return stated, shared

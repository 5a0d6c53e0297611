"""Counts of what the page's server refuses, for the log."""

from collections import Counter
from typing import Literal

Refusal = Literal[
    "foreign hosts",
    "foreign origins",
    "missing tokens",
    "wrong tokens",
    "unknown commands",
    "oversized messages",
    "malformed messages",
    "commands in too fast succession",
    "pages beyond the limit",
    "connections beyond the limit",
    "requests that took too long",
    "malformed requests",
    "unknown addresses",
    "wrong methods",
]


class Refusals:
    """Counts by reason."""

    def __init__(self) -> None:
        self._counts: Counter[Refusal] = Counter()

    def add(self, reason: Refusal) -> None:
        """Counts one refusal."""
        self._counts[reason] += 1

    def count(self, reason: Refusal) -> int:
        """How many were refused for this reason."""
        return self._counts[reason]

    def describe(self) -> str:
        """One line, ``refused: 3 wrong tokens, 2 foreign origins``; empty where nothing was refused."""
        counts = ", ".join(f"{count} {reason}" for reason, count in self._counts.most_common())
        return counts and f"refused: {counts}"

"""Notices of what happens with every message, at most one a second for each topic, with their number."""

import re
from collections.abc import Iterator

from calgraph.live.source import Notice, NoticeKind
from calgraph.sensors.names import CONTROL_CHARACTERS

# Texts of servers are cut: they may have any length.
_MAX_TEXT = 300
_CONTROL_CHARACTERS = re.compile(f"[{CONTROL_CHARACTERS}]+")


class NoticeLimiter:
    """Collects notices, and gives one for all of a kind and topic that came within an interval (s).

    Times are those of one clock, s.
    """

    def __init__(self, interval: float) -> None:
        self._interval = interval
        self._waiting: dict[tuple[NoticeKind, str | None], tuple[str, int]] = {}
        self._given: dict[tuple[NoticeKind, str | None], float] = {}

    def add(self, kind: NoticeKind, text: str, topic: str | None = None, count: int = 0) -> None:
        """Adds a notice; of several, the first one's text is given, and the sum of their counts."""
        first, before = self._waiting.get((kind, topic), (text, 0))
        self._waiting[kind, topic] = first, before + count

    def take(self, now: float) -> Iterator[Notice]:
        """The notices whose interval is over."""
        if not self._waiting:
            return
        for key in list(self._waiting):
            if now - self._given.get(key, float("-inf")) >= self._interval:
                text, count = self._waiting.pop(key)
                self._given[key] = now
                kind, topic = key
                yield Notice(kind, clean_text(text), topic, count)


def clean_text(text: str) -> str:
    """A text that may come from a server, on one line."""
    line = _CONTROL_CHARACTERS.sub(" ", text)
    return line if len(line) <= _MAX_TEXT else f"{line[:_MAX_TEXT]} ..."

"""Sizes of paper. Lengths on paper are in mm, as printers have them; boards are in m, as everywhere else."""

import re
from dataclasses import dataclass

from calgraph.errors import InputError

MARGIN = 15.0
"""Around what belongs to the board, mm: room for rulers and marks, and more than any printer leaves blank."""

_LONGEST = 5000.0
"""A PDF's page has at most 14400 points, 5080 mm, along an edge."""
_NAMED = {
    **{f"a{n}": (float(width), float(height)) for n, (width, height) in enumerate(
        [(841, 1189), (594, 841), (420, 594), (297, 420), (210, 297), (148, 210)]
    )},
    "letter": (215.9, 279.4), "legal": (215.9, 355.6), "tabloid": (279.4, 431.8),
    "ansi-c": (431.8, 558.8), "ansi-d": (558.8, 863.6), "ansi-e": (863.6, 1117.6),
}  # fmt: skip


@dataclass(frozen=True)
class Paper:
    """One sheet of paper as it lies in the printer."""

    width: float
    """mm."""
    height: float
    """mm."""

    @property
    def turned(self) -> "Paper":
        """The same paper the other way round: portrait for landscape."""
        return Paper(self.height, self.width)

    @property
    def inner(self) -> tuple[float, float]:
        """Width and height within the margins, mm."""
        return self.width - 2 * MARGIN, self.height - 2 * MARGIN


def parse_paper(text: str) -> Paper:
    """Paper by name (``A4``, ``letter``) or as ``WIDTHxHEIGHT`` in mm.

    Raises:
        InputError: no such paper, or one that is too small or too large for a page.

    """
    name = text.strip().lower()
    if name in _NAMED:
        return Paper(*_NAMED[name])
    width, height = parse_size(text, f"`paper`: is none of {', '.join(_NAMED)}, nor")
    if min(width, height) < 4 * MARGIN or max(width, height) > _LONGEST:
        raise InputError(f"`paper`: edges must be from {4 * MARGIN:g} to {_LONGEST:g} mm, got {text!r}")
    return Paper(width, height)


def parse_size(text: str, complaint: str) -> tuple[float, float]:
    """``WIDTHxHEIGHT`` in mm as two numbers.

    Args:
        text: such as ``1200x900``.
        complaint: what the message says first if it is not.

    Raises:
        InputError: it is not.

    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*[x×]\s*(\d+(?:\.\d*)?)\s*(?:mm)?\s*", text, re.IGNORECASE)
    if not match or not all(float(length) > 0 for length in match.groups()):
        raise InputError(f"{complaint} WIDTHxHEIGHT in mm, such as 1200x900; got {text!r}")
    return float(match[1]), float(match[2])

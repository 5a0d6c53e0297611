"""Sizes of paper. Lengths on paper are in mm; boards are in m, as everywhere else."""

import re
from dataclasses import dataclass

from calgraph.errors import InputError

MARGIN = 15.0
"""Margin around the board, mm: space for rulers and marks, and more than any printer leaves blank."""

COMMON_PAPERS = ("A4", "A3", "A2", "A1", "A0")
"""Papers that a board is put on unless another is asked for, the smallest first."""
_MAX_EDGE = 5000.0
"""A PDF's page has at most 14400 points, 5080 mm, along an edge."""
_PAPER_SIZES = {
    **{f"a{n}": (float(width), float(height)) for n, (width, height) in enumerate(
        [(841, 1189), (594, 841), (420, 594), (297, 420), (210, 297), (148, 210)]
    )},
    "letter": (215.9, 279.4), "legal": (215.9, 355.6), "tabloid": (279.4, 431.8),
    "ansi-c": (431.8, 558.8), "ansi-d": (558.8, 863.6), "ansi-e": (863.6, 1117.6),
}  # fmt: skip


@dataclass(frozen=True)
class Paper:
    """One sheet of paper in its orientation in the printer."""

    width: float
    """mm."""
    height: float
    """mm."""

    @property
    def rotated(self) -> "Paper":
        """The same paper in the other orientation."""
        return Paper(self.height, self.width)

    @property
    def printable_size(self) -> tuple[float, float]:
        """Width and height within the margins, mm."""
        return self.width - 2 * MARGIN, self.height - 2 * MARGIN


def parse_paper(text: str) -> Paper:
    """Parses paper given by name (``A4``, ``letter``) or as ``WIDTHxHEIGHT`` in mm.

    Raises:
        InputError: unknown paper, or one that is too small or too large for a page.
    """
    name = text.strip().lower()
    if name in _PAPER_SIZES:
        return Paper(*_PAPER_SIZES[name])
    width, height = parse_size(text, f"`paper`: is none of {', '.join(_PAPER_SIZES)}, nor")
    if min(width, height) < 4 * MARGIN or max(width, height) > _MAX_EDGE:
        raise InputError(f"`paper`: edges must be from {4 * MARGIN:g} to {_MAX_EDGE:g} mm, got {text!r}")
    return Paper(width, height)


def parse_size(text: str, message: str) -> tuple[float, float]:
    """Parses ``WIDTHxHEIGHT`` in mm.

    Args:
        text: such as ``1200x900``.
        message: beginning of the error message.

    Raises:
        InputError: the text has another form.
    """
    if re.fullmatch(r"\s*[\d.]+\s*[x×]\s*[\d.]+\s*m\s*|\s*\d\.\d*\s*[x×]\s*\d\.\d*\s*", text, re.IGNORECASE):
        raise InputError(f"{message} WIDTHxHEIGHT in mm, such as 1200x900; got {text!r}, which seems to be in m")
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*[x×]\s*(\d+(?:\.\d*)?)\s*(?:mm)?\s*", text, re.IGNORECASE)
    if not match or not all(float(length) > 0 for length in match.groups()):
        raise InputError(f"{message} WIDTHxHEIGHT in mm, such as 1200x900; got {text!r}")
    return float(match[1]), float(match[2])

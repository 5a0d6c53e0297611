"""Point clouds as lines of numbers: ``.xyz``, ``.pts``, ``.asc``, ``.txt`` and ``.csv``."""

import re

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import check_point_count
from calgraph.recording.point_cloud_columns import Columns

_COMMENT = ("#", "//")


def parse_points(text: str, limits: LimitSettings = LimitSettings()) -> Columns:
    """The columns (N,) of a text with one point a line, separated by spaces, commas or semicolons.

    A first line with names (``x y z ring``) states the columns, also as a comment; without one, the first three
    are x, y, z. A first line with one number, as ``.pts`` files have it, is the number of points.

    Raises:
        ValueError: it has no x, y or z, more points than the limit, or a line has other values.
    """
    check_point_count(text.count("\n"), limits)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    head = _split(lines[0].lstrip("#/")) if lines else []
    names = [] if all(map(_is_number, head)) else [name.strip("\"'").lower() for name in head]
    body = [line for line in lines[bool(names) :] if not line.startswith(_COMMENT)]
    rows = [_split(line) for line in (body[1:] if body and len(_split(body[0])) == 1 else body)]
    width = len(rows[0]) if rows else 3
    if not {"x", "y", "z"} <= set(names):
        names = ["x", "y", "z"]  # of a comment, or without any
    if width < len(names) or any(len(row) != width for row in rows):
        wrong = next((row for row in rows if len(row) != width), rows[0] if rows else [])
        raise ValueError(f"each line must have x, y and z, and as many values as the others, got {wrong[:5]}")
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    return {name: table[:, i] for i, name in enumerate(names) if names.index(name) == i}


def is_point_table(head: str) -> bool:
    """Whether the first line of a CSV has the names of coordinates, or three numbers or four."""
    words = [word.strip("\"'").lower() for word in _split(head.lstrip("#/"))]
    return {"x", "y", "z"} <= set(words) or (len(words) in (3, 4) and all(map(_is_number, words)))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _split(line: str) -> list[str]:
    return re.split(r"\s*[,;]\s*|\s+", line.strip().rstrip(",;"))

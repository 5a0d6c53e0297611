"""Trajectories as text, a pose in each line: ``time x y z qx qy qz qw``, as the TUM benchmark has them.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012.
"""

from pathlib import Path

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.recording.damage import check_fetched, check_unpacked_size, wrap_errors
from calgraph.recording.record_list import IndexedRecording, record_message
from calgraph.sensors import Pose

_SUFFIXES = (".tum", ".txt", ".csv")
# time x y z qx qy qz qw.
_COLUMNS = 8
# Lines that are searched for the first pose, and characters of each: programs write a header.
_HEADER_LINES, _LINE = 20, 1000


class TrajectoryFile(IndexedRecording):
    """The poses of one text file; their topic is the file's name without suffix.

    Args:
        path: the file.
        limits: maximum size.

    Raises:
        InputError: there is no pose.
        RecordingError: a line is damaged.
    """

    def __init__(self, path: Path, limits: LimitSettings) -> None:
        check_fetched(path)
        with wrap_errors(path):
            check_unpacked_size(path.stat().st_size, limits)
            lines = path.read_text("utf-8-sig", errors="replace").splitlines()
            rows = [_parse(line, k + 1) for k, line in enumerate(lines)]
        poses = [row for row in rows if len(row) and np.isfinite(row[0])]
        if not poses:
            raise InputError(f"{path}: has no pose with a time")
        topic = path.stem
        messages = [Pose(float(row[0]), "", row[1:4], row[4:]) for row in poses]
        super().__init__(
            path, [record_message(topic, one) for one in messages], {topic: "trajectory"}, sources=(path,)
        )


def is_trajectory(path: Path) -> bool:
    """Whether a file has a pose in each line; by the first line of eight numbers among the first lines."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as opened:
        return any(len(_split(opened.readline(_LINE))) == _COLUMNS for _ in range(_HEADER_LINES))


def _split(line: str) -> list[float]:
    """The numbers of a line, separated by blanks or commas; none where there is another text."""
    try:
        return [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        return []


def _parse(line: str, number: int) -> Array:
    """(8,) time and pose, or (0,) of comments and headers."""
    values = _split(line)
    if values and len(values) != _COLUMNS:
        raise ValueError(f"line {number} must have {_COLUMNS} numbers, time x y z qx qy qz qw, got {len(values)}")
    return np.array(values)

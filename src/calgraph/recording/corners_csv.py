"""Corners of a board that another program detected, as CSV: one topic a camera."""

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.recording.damage import check_fetched, check_unpacked_size, wrap_errors
from calgraph.recording.file_names import SNAPSHOT_SPACING
from calgraph.recording.record_list import IndexedRecording, record_message
from calgraph.sensors import DetectedCorners

CORNERS, TIMES = "xy.csv", "timestamps.csv"
_FRAME = ("sync_index", "cam_id")
_COLUMNS = (*_FRAME, "img_loc_x", "img_loc_y", "obj_loc_x", "obj_loc_y")
_DEPTH, _TIME = "obj_loc_z", "frame_time"

Frame = tuple[int, str]
"""Number of the set of frames, and camera."""


@dataclass
class _Corners:
    """The corners of one frame, as they are read."""

    time: float | None = None
    board_points: list[tuple[float, float, float]] = field(default_factory=list)
    pixels: list[tuple[float, float]] = field(default_factory=list)


class CornersRecording(IndexedRecording):
    """Detected corners by camera and frame, in the form that caliscope writes.

    ``xy.csv`` has a line for each corner, ``timestamps.csv`` beside it one for each frame. The topic of the camera
    0 is ``cam_0``. Stamps are those of timestamps.csv, or of a column ``frame_time`` of xy.csv; without both,
    frames of one ``sync_index`` are a snapshot.

    Args:
        path: the CSV file, or the folder with xy.csv.
        limits: maximum size.

    Raises:
        InputError: there are no corners.
        RecordingError: a file is damaged.
    """

    def __init__(self, path: Path, limits: LimitSettings) -> None:
        file = path / CORNERS if path.is_dir() else path
        frames: dict[Frame, _Corners] = {}
        _read_rows(file, _COLUMNS, partial(_add_corner, frames), limits)
        times = file.with_name(TIMES)
        if times.is_file():
            _read_rows(times, (*_FRAME, _TIME), partial(_add_time, frames), limits)
        timed = all(corners.time is not None for corners in frames.values())
        if not timed and any(corners.time is not None for corners in frames.values()):
            lacking = next(frame for frame, corners in frames.items() if corners.time is None)
            raise RecordingError(f"{times}: has no {_TIME} of sync_index {lacking[0]}, cam_id {lacking[1]}")
        if not frames:
            raise InputError(f"{file}: has no corner")
        messages = [
            (
                _topic(camera),
                _message(number * SNAPSHOT_SPACING if corners.time is None else corners.time, corners),
            )
            for (number, camera), corners in frames.items()
        ]
        topics = {topic for topic, _ in messages}
        records = [record_message(topic, message) for topic, message in messages]
        sources = (path,) if path.is_dir() or not times.is_file() else (path, times)
        types = dict.fromkeys(topics, "corners")
        super().__init__(
            path, records, types, time_bases={} if timed else dict.fromkeys(topics, "pose"), sources=sources
        )


def is_corners(path: Path) -> bool:
    """Whether a file, or a folder by the file in it, has detected corners; by its first line."""
    file = path / CORNERS if path.is_dir() else path
    if file.suffix.lower() != ".csv" or not file.is_file():
        return False
    with file.open("rb") as opened:
        names = opened.readline(10_000).decode("utf-8-sig", errors="replace").strip().split(",")
    return {name.strip() for name in names} >= set(_COLUMNS)


def _topic(camera: str) -> str:
    return f"cam_{camera}" if camera.isdigit() else camera


def _message(stamp: float, corners: _Corners) -> DetectedCorners:
    points = np.array(corners.board_points, dtype=np.float64).reshape(-1, 3)
    return DetectedCorners(stamp, "", points, np.array(corners.pixels, dtype=np.float64).reshape(-1, 2))


def _add_corner(frames: dict[Frame, _Corners], row: Mapping[str, str]) -> None:
    corners = frames.setdefault(_frame(row), _Corners())
    u, v, x, y = (_number(row, name) for name in _COLUMNS[2:])
    corners.board_points.append((x, y, _number(row, _DEPTH) if row.get(_DEPTH) else 0.0))
    corners.pixels.append((u, v))
    if row.get(_TIME):
        corners.time = _number(row, _TIME)


def _add_time(frames: dict[Frame, _Corners], row: Mapping[str, str]) -> None:
    frames.setdefault(_frame(row), _Corners()).time = _number(row, _TIME)


def _read_rows(
    file: Path, columns: tuple[str, ...], add: Callable[[Mapping[str, str]], None], limits: LimitSettings
) -> None:
    """Calls a function with each row of a CSV file by the names in its first line."""
    check_fetched(file)
    with wrap_errors(file):
        check_unpacked_size(file.stat().st_size, limits)
        with file.open(encoding="utf-8-sig", newline="") as opened:
            rows = csv.DictReader(opened, skipinitialspace=True)
            missing = [name for name in columns if name not in (rows.fieldnames or ())]
            if missing:
                raise ValueError(f"has no column {', '.join(missing)}")
            for row in rows:
                with wrap_errors(f"{file}: line {rows.line_num}"):
                    add(row)


def _frame(row: Mapping[str, str]) -> Frame:
    number = _number(row, _FRAME[0])
    if number != int(number):
        raise ValueError(f"{_FRAME[0]} must be a whole number, got {number:g}")
    return int(number), row[_FRAME[1]].strip()


def _number(row: Mapping[str, str], name: str) -> float:
    text = row[name]
    try:
        number = float(text)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, got {text!r:.40}") from None
    if not np.isfinite(number):
        raise ValueError(f"{name} must be finite, got {text}")
    return number

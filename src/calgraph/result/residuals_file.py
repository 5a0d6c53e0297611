"""residuals.csv: every residual that the report draws, one row per corner or beam end, for other programs."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from calgraph.io.text_writing import escape_formula, write_csv
from calgraph.result.calibration import Calibration
from calgraph.result.pictures import BeamView, BoardView, DriveView

_COLUMNS = ("sensor", "capture", "time", "unit", "x", "y", "z", "residual", "residual_x", "residual_y")


def save_residuals(calibration: Calibration, path: Path) -> None:
    """Writes residuals.csv in one step; docs/formats.md describes its columns.

    Raises:
        InputError: ``path`` cannot be written.
    """
    pictures, times = calibration.pictures, capture_times(calibration)
    of_boards = (_board_rows(view, times.get(view.capture, np.nan)) for view in pictures.board_views)
    of_beams = chain(map(_beam_rows, pictures.beam_views), map(_beam_rows, pictures.drive_views))
    write_csv(path, _COLUMNS, chain.from_iterable(chain(of_boards, of_beams)))


def capture_times(calibration: Calibration) -> dict[int, float]:
    """The middle of each capture, s from the start of the recording."""
    return {row.capture: (row.start + row.end) / 2 for row in calibration.evidence.captures}


def _board_rows(view: BoardView, time: float) -> Iterator[tuple[object, ...]]:
    if view.residuals is None:
        return
    head = escape_formula(view.sensor), view.capture, _format_time(time)
    # Python formats its own numbers in a fraction of the time that it takes for NumPy's.
    measured, residuals = view.measured.tolist(), view.residuals.tolist()
    if view.measured.shape[1] == 2:
        sizes = np.hypot(*view.residuals.T).tolist()
        for (x, y), (dx, dy), size in zip(measured, residuals, sizes, strict=True):
            yield *head, "px", f"{x:.2f}", f"{y:.2f}", "", f"{size:.4f}", f"{dx:.4f}", f"{dy:.4f}"
    else:
        for (x, y, z), residual in zip(measured, residuals, strict=True):
            yield *head, "m", f"{x:.4f}", f"{y:.4f}", f"{z:.4f}", f"{residual:.6f}", "", ""


def _beam_rows(view: BeamView | DriveView) -> Iterator[tuple[object, ...]]:
    head, rows = escape_formula(view.sensor), zip(view.times, view.points.tolist(), view.residuals, strict=True)
    for time, point, residual in rows:
        x, y, z = (*(f"{value:.4f}" for value in point), "")[:3]
        yield head, "", _format_time(time), "m", x, y, z, f"{residual:.6f}", "", ""


def _format_time(time: float) -> str:
    return f"{time:.3f}" if np.isfinite(time) else ""

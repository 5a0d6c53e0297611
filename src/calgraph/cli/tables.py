"""What a calibration prints on a terminal: readable at 80 columns."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calgraph.geometry import Array, se3
from calgraph.result import Calibration

_GRADE_COLOR = {"good": "green", "weak": "yellow", "unobservable": "red"}


def print_calibration(calibration: Calibration, out: Path, truth: Mapping[str, Array] | None = None) -> None:
    """Prints each sensor's pose, its standard deviation, and its error where the truth is known.

    Args:
        calibration: the result.
        out: the folder its files are in.
        truth: true poses T_root_sensor (4, 4) by sensor.
    """
    console = Console(width=None if Console().is_terminal else 100)
    table = Table(title=f"Poses in the frame of {escape(calibration.root)}", title_justify="left", box=None, pad_edge=False)
    table.add_column("sensor")
    table.add_column("x y z, m", justify="right")
    table.add_column("roll pitch yaw, °", justify="right")
    table.add_column("± mm", justify="right")
    table.add_column("± °", justify="right")
    if truth:
        table.add_column("error", justify="right")
    table.add_column("verdict")
    for sensor in calibration.sensors:
        T = sensor.T_root_sensor
        spread = np.sqrt(np.diag(sensor.covariance))
        row = [
            escape(sensor.name),
            " ".join(f"{v:7.3f}" for v in T[:3, 3]),
            " ".join(f"{v:7.2f}" for v in _roll_pitch_yaw(T[:3, :3])),
            f"{1000 * np.linalg.norm(spread[:3]):.1f}" if sensor.parent else "root",
            f"{np.degrees(np.linalg.norm(spread[3:])):.3f}" if sensor.parent else "",
        ]
        if truth:
            error = se3.difference(T, truth[sensor.name])
            metres, angle = np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
            row.append(f"{1000 * metres:.1f} mm {angle:.3f}°" if sensor.parent else "")
        grade = sensor.verdict.grade
        row.append(f"[{_GRADE_COLOR[grade]}]{grade}[/]")
        table.add_row(*row)
    console.print(table)
    for sensor in calibration.sensors:
        if sensor.verdict.reason:
            console.print(f"{escape(sensor.name)}: {escape(sensor.verdict.reason)}", highlight=False)
    console.print(f"Results are in {escape(str(out))}; open {escape(str(out / 'report.html'))}", highlight=False)


def _roll_pitch_yaw(R: Array) -> Array:
    """Fixed-axis angles (3,), degrees, with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.degrees([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])

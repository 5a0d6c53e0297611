"""Poses as text: a row for each sensor, as notebooks and consoles show a calibration."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.result.sensor_pose import SensorPose

_HEAD = ("sensor", "x, m", "y, m", "z, m", "roll, °", "pitch, °", "yaw, °", "σ, mm", "σ, °", "verdict")


def list_poses(sensors: Iterable[SensorPose], unconnected: Mapping[str, str]) -> list[Sequence[str]]:
    """The head, and rows: pose in the root's frame, σ along and about the worst axis, and verdict."""
    rows: list[Sequence[str]] = [_HEAD]
    for sensor in sensors:
        T, root = sensor.T_root_sensor, sensor.parent is None
        translation, rotation = sensor.worst_stddev
        rows.append((
            sensor.name,
            *(f"{value + 0.0:.4f}" for value in T[:3, 3].round(4)),
            *(f"{value + 0.0:.3f}" for value in np.degrees(roll_pitch_yaw(T[:3, :3])).round(3)),
            *(("", "") if root else (f"{1e3 * translation:.2g}", f"{np.degrees(rotation):.2g}")),
            "root" if root else sensor.verdict.grade,
        ))  # fmt: skip
    return [*rows, *((name, *[""] * 8, "not calibrated") for name in unconnected)]


def format_rows(rows: Sequence[Sequence[str]]) -> str:
    """Rows of equal length as lines with aligned columns, the first one to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        f"{row[0]:<{widths[0]}}  " + "  ".join(f"{text:>{w}}" for text, w in zip(row[1:], widths[1:], strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def rows_to_html(rows: Sequence[Sequence[str]]) -> str:
    """Rows as an HTML table, the first one as its head."""
    head, *others = (
        "".join(f"<{tag}>{escape(text)}</{tag}>" for text in row)
        for row, tag in ((row, "td" if k else "th") for k, row in enumerate(rows))
    )
    body = "".join(f"<tr>{row}</tr>" for row in others)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

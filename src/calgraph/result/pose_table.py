"""A calibration as a table, a row for each sensor: as text, as HTML, and for pandas."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.errors import CalgraphError
from calgraph.geometry import so3
from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.result.sensor_pose import SensorPose

if TYPE_CHECKING:
    import pandas as pd

    from calgraph.result.calibration import Calibration

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


_DEVIATIONS = tuple(f"stddev_{axis}" for axis in ("x", "y", "z", "rx_deg", "ry_deg", "rz_deg"))


def to_dataframe(calibration: "Calibration") -> "pd.DataFrame":
    """A pandas table with a row for each sensor, those without a pose included; needs ``calgraph[tables]``.

    Indexed by ``sensor``. Columns: ``kind``, ``frame_id``, ``parent``; the pose in the root's frame as
    ``x y z`` (m), ``qx qy qz qw``, and ``roll_deg pitch_deg yaw_deg`` about fixed axes; standard deviations
    along and about the root's axes, ``stddev_x`` ... (m) and ``stddev_rx_deg`` ...; ``clock_offset`` and
    ``clock_offset_stddev`` (s), missing where not estimated; ``verdict`` (good, weak, unobservable,
    unconnected) and its ``reason``.

    Raises:
        CalgraphError: pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise CalgraphError(
            "tables need pandas, which is not installed: pip install 'calgraph[tables]', or pip install pandas"
        ) from None
    unconnected = calibration.evidence.unconnected.items()
    rows = [
        *map(_row, calibration.sensors),
        *({"sensor": name, "verdict": "unconnected", "reason": reason} for name, reason in unconnected),
    ]
    return pd.DataFrame(rows, columns=list(_row(calibration.sensors[0]))).set_index("sensor")


def _row(sensor: SensorPose) -> dict[str, Any]:
    T = sensor.T_root_sensor
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = so3.quaternion(T[:3, :3]).tolist()
    roll, pitch, yaw = (np.degrees(roll_pitch_yaw(T[:3, :3])) + 0.0).tolist()  # no negative zeros
    stddev = np.sqrt(np.diag(sensor.covariance))
    stddev[3:] = np.degrees(stddev[3:])
    return {
        "sensor": sensor.name, "kind": sensor.kind, "frame_id": sensor.frame_id, "parent": sensor.parent,
        "x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw,
        "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw,
        **dict(zip(_DEVIATIONS, stddev.tolist(), strict=True)),
        "clock_offset": _number(sensor.clock_offset), "clock_offset_stddev": _number(sensor.clock_offset_stddev),
        "verdict": sensor.verdict.grade, "reason": sensor.verdict.reason,
    }  # fmt: skip


def _number(value: float | None) -> float:
    return np.nan if value is None else value

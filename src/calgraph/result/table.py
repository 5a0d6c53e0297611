"""A calibration as a pandas table, a row a sensor, for notebooks."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.errors import CalgraphError
from calgraph.geometry import so3
from calgraph.result.calibration import Calibration, SensorPose
from calgraph.result.exports import roll_pitch_yaw

if TYPE_CHECKING:
    import pandas as pd

_DEVIATIONS = tuple(f"stddev_{axis}" for axis in ("x", "y", "z", "rx_deg", "ry_deg", "rz_deg"))


def to_dataframe(calibration: Calibration) -> "pd.DataFrame":
    """The table that :meth:`Calibration.to_dataframe` describes.

    Raises:
        CalgraphError: pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise CalgraphError(
            "tables need pandas, which is not installed: pip install 'calgraph[tables]', or pip install pandas"
        ) from None
    rows = [*map(_row, calibration.sensors), *_unconnected(calibration)]
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


def _unconnected(calibration: Calibration) -> Iterator[dict[str, Any]]:
    """Sensors without a pose have a row, too: a table that leaves them out hides that they are missing."""
    for name, reason in calibration.unconnected.items():
        yield {"sensor": name, "verdict": "unconnected", "reason": reason}

"""A calibration as a pandas table, one row per sensor."""

from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.errors import CalgraphError
from calgraph.geometry import so3
from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.result.calibration import Calibration
from calgraph.result.sensor_pose import SensorPose

if TYPE_CHECKING:
    import pandas as pd

_DEVIATIONS = tuple(f"stddev_{axis}" for axis in ("x", "y", "z", "rx_deg", "ry_deg", "rz_deg"))


def to_dataframe(calibration: Calibration) -> "pd.DataFrame":
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

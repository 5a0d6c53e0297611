"""Real data: a scanner and wheels of one robot (fr079 of Radish), whose scanner is in the middle."""

import bz2
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.geometry import Array, so3
from calgraph.recording import MessageRecording
from calgraph.sensors import LaserScan, Pose


def read_log(path: Path) -> tuple[Array, Array, Array]:
    """Stamps (N,), s, ranges (N, 360), m, and x, y, yaw (N, 3) by the wheels; m and rad.

    A line is ``FLASER count ranges… x y theta odom_x odom_y odom_theta stamp host logger_stamp``.
    """
    with bz2.open(path, "rt", encoding="ascii") as file:
        lines = [line.split() for line in file if line.startswith("FLASER 360 ")]
    rows = np.array([words[2:369] for words in lines], dtype=np.float64)
    return rows[:, 366], rows[:, :360], rows[:, 363:366]


@pytest.mark.slow
def test_wheels_show_that_the_scanner_is_in_the_middle(data_dir: Path) -> None:
    """In one minute with curves to both sides; laser and axle coincide in this log to some centimetres."""
    stamps, ranges, odometry = read_log(next((data_dir / "radish-fr079-2d-laser-odometry").rglob("*.bz2")))
    since = stamps - stamps[0]
    used = (since >= 600.0) & (since < 660.0)
    angles = np.radians(np.arange(360) * 0.5 - 90)
    recording = MessageRecording({
        "/laser": [
            LaserScan(float(t), "laser", angles, np.where(one < 50.0, one, np.inf))
            for t, one in zip(since[used], ranges[used], strict=True)
        ],
        "/odom": [
            Pose(float(t), "", np.array([x, y, 0.0]), so3.quaternion(so3.exp(np.array([0.0, 0.0, yaw]))))
            for t, (x, y, yaw) in zip(since[used], odometry[used], strict=True)
        ],
    })  # fmt: skip
    sensors = {"laser": {"kind": "lidar2d", "topic": "/laser"}, "odom": {"kind": "trajectory", "topic": "/odom"}}
    base = {"wheels": "odom", "axle": "middle"}
    rig = Rig.model_validate(
        {"root": "laser", "target": {"kind": "surroundings"}, "base": base, "sensors": sensors}
    )
    found = calibrate_drive(rig, recording, DriveOptions()).base
    assert found is not None
    y, stddev = found.T_base_root[1, 3], np.sqrt(found.covariance[1, 1])
    assert stddev < 0.02
    assert abs(y) < 3 * stddev
    assert abs(found.T_base_root[0, 3]) < 0.05

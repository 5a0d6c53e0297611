"""Real data: three devices with visual-inertial odometry on one rig."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.geometry import Array, se3, so3
from calgraph.recording import MessageRecording
from calgraph.result import Calibration
from calgraph.sensors import Pose

NAMES = ("caligula", "mars", "nero")


def read_rows(path: Path) -> Array:
    """(N, 8) time, place and quaternion."""
    with gzip.open(path, "rt") as opened:
        return np.genfromtxt(opened, delimiter=",", comments="#")


def turn_rates(rows: Array, times: Array) -> Array:
    """(M,) turn rates, rad/s, at times from the first pose on."""
    _, first = np.unique(rows[:, 0], return_index=True)
    rows = rows[first]
    R = so3.from_quaternion(rows[:, 4:] / np.linalg.norm(rows[:, 4:], axis=1)[:, None])
    rates = np.linalg.norm(so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]), axis=1) / np.diff(rows[:, 0])
    middle = (rows[:-1, 0] + rows[1:, 0]) / 2 - rows[0, 0]
    return np.convolve(np.interp(times, middle, rates), np.ones(10) / 10, "same")


def align(rows: dict[str, Array]) -> dict[str, Array]:
    """The same with clocks that differ by less than 0.2 s, by the turn rates of whole recordings."""
    times = np.arange(0, 400, 0.1)
    first = {name: turn_rates(one, times) for name, one in rows.items()}
    aligned = {}
    for name, one in rows.items():
        a, b = first[NAMES[0]], first[name]
        lag = int(np.argmax(np.correlate(b - b.mean(), a - a.mean(), "full"))) - (len(a) - 1)
        aligned[name] = one.copy()
        aligned[name][:, 0] += 1000.0 - one[0, 0] - lag * 0.1
    return aligned


def calibrate(rows: dict[str, Array], root: str) -> Calibration:
    sensors = {name: {"kind": "trajectory", "topic": f"/{name}"} for name in rows}
    rig = Rig.model_validate({"root": root, "target": {"kind": "surroundings"}, "sensors": sensors})
    recording = MessageRecording({
        f"/{name}": [Pose(float(row[0]), name, row[1:4], row[4:]) for row in one] for name, one in rows.items()
    })  # fmt: skip
    return calibrate_drive(rig, recording, DriveOptions())


@pytest.mark.slow
def test_three_devices_close_a_loop(data_dir: Path) -> None:
    """Each pair by itself: from A to B, to C and to A, within three standard deviations of the pairs."""
    folder = data_dir / "hand-eye-tango-triplet"
    rows = align({name: read_rows(folder / f"{name}.csv.gz") for name in NAMES})
    loop, variance = np.eye(4), np.zeros((6, 6))
    for a, b in zip(NAMES, (*NAMES[1:], NAMES[0]), strict=True):
        pair = calibrate({a: rows[a], b: rows[b]}, a)
        assert b not in pair.evidence.unconnected
        adjoint = np.kron(np.eye(2), loop[:3, :3])
        variance += adjoint @ pair[b].covariance @ adjoint.T
        loop = loop @ pair[b].T_root_sensor
    error = se3.difference(loop, np.eye(4))
    assert error @ np.linalg.solve(variance, error) / 6 < 3

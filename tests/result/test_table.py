"""A calibration as a pandas table."""

import sys

import numpy as np
import pytest

from calgraph.errors import CalgraphError
from calgraph.geometry import se3, so3
from calgraph.result import Calibration, to_dataframe


def test_poses_are_those_of_the_calibration(calibration: Calibration) -> None:
    table = to_dataframe(calibration)
    for sensor in calibration.sensors:
        row = table.loc[sensor.name]
        T = se3.from_xyz_quaternion(
            row[["x", "y", "z"]].astype(float), row[["qx", "qy", "qz", "qw"]].astype(float)
        )
        assert np.allclose(T, sensor.T_root_sensor, rtol=0, atol=1e-12)


def test_angles_are_degrees_about_fixed_axes(calibration: Calibration) -> None:
    roll, pitch, yaw = np.radians(
        to_dataframe(calibration).loc["laser", ["roll_deg", "pitch_deg", "yaw_deg"]].astype(float)
    )
    x, y, z = np.eye(3)
    R = so3.exp(yaw * z) @ so3.exp(pitch * y) @ so3.exp(roll * x)
    assert np.allclose(R, calibration["laser"].T_root_sensor[:3, :3])


def test_deviations_are_roots_of_the_covariance(calibration: Calibration) -> None:
    row = to_dataframe(calibration).loc["camera"]
    assert row["stddev_y"] == pytest.approx(np.sqrt(calibration["camera"].covariance[1, 1]))
    assert row["stddev_rz_deg"] == pytest.approx(np.degrees(np.sqrt(calibration["camera"].covariance[5, 5])))


def test_every_sensor_has_a_row_with_its_verdict(calibration: Calibration) -> None:
    table = to_dataframe(calibration)
    assert dict(table["verdict"]) == {
        "lidar": "good", "camera": "good", "camera_2": "good", "laser": "weak", "sonar": "unconnected",
    }  # fmt: skip
    assert "never saw the board" in table.loc["sonar", "reason"]
    assert np.isnan(table.loc["sonar", "x"])


def test_clock_is_a_number_only_where_it_was_estimated(calibration: Calibration) -> None:
    clocks = to_dataframe(calibration)["clock_offset"]
    assert clocks["camera"] == 0.0123
    assert np.isnan(clocks["laser"])


def test_parent_of_the_root_is_missing(calibration: Calibration) -> None:
    parents = to_dataframe(calibration)["parent"]
    assert parents.isna()["lidar"]
    assert parents["camera_2"] == "camera"


def test_without_pandas_the_command_that_installs_it_is_given(
    calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(CalgraphError, match=r"pip install 'calgraph\[tables\]'"):
        to_dataframe(calibration)

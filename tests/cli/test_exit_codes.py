"""Exit codes of calibrations: what is not calibrated, by name."""

import numpy as np
import pytest

from calgraph.cli.calibrate import fail_if_not_calibrated
from calgraph.errors import CalibrationError
from calgraph.result import Calibration, Evidence, SensorPose, Verdict, join_covariances
from calgraph.result.sensor_pose import Grade


def calibration(grade: Grade, unconnected: dict[str, str] | None = None) -> Calibration:
    return Calibration(
        root="lidar",
        sensors=(
            SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good")),
            SensorPose("laser", "lidar", "laser", "lidar2d", np.eye(4), Verdict(grade, "its height is loose")),
        ),
        joint_covariance=join_covariances([np.zeros((6, 6)), 1e-6 * np.eye(6)]),
        evidence=Evidence(estimator="bundle", unconnected=unconnected or {}),
    )


@pytest.mark.parametrize(("grade", "strict"), [("good", False), ("good", True), ("weak", False)])
def test_these_are_calibrated(grade: Grade, strict: bool) -> None:
    fail_if_not_calibrated(calibration(grade), strict=strict)


def test_a_pose_that_is_not_observable_is_not_calibrated() -> None:
    with pytest.raises(CalibrationError, match=r"^laser is not calibrated: its pose is not observable$"):
        fail_if_not_calibrated(calibration("unobservable"))


def test_a_weak_pose_is_refused_where_the_user_is_strict() -> None:
    with pytest.raises(CalibrationError, match=r"^laser is weak, which --strict refuses$"):
        fail_if_not_calibrated(calibration("weak"), strict=True)


def test_a_sensor_without_a_pose_is_named_with_its_reason() -> None:
    with pytest.raises(CalibrationError, match=r"^camera is not calibrated: detected nothing$"):
        fail_if_not_calibrated(calibration("good", {"camera": "detected nothing"}))


def test_sensors_without_a_pose_for_the_same_reason_are_named_together() -> None:
    lost = {"camera": "detected nothing", "laser_2": "has no messages", "lidar_2": "detected nothing"}
    with pytest.raises(CalibrationError) as error:
        fail_if_not_calibrated(calibration("good", lost))
    assert str(error.value).splitlines() == [
        "camera, lidar_2 are not calibrated: detected nothing",
        "laser_2 is not calibrated: has no messages",
    ]

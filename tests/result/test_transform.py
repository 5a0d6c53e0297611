"""The transform between any two sensors."""

import numpy as np
import pytest

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import se3
from calgraph.result import Calibration


def test_from_the_root_it_is_the_pose(calibration: Calibration) -> None:
    np.testing.assert_allclose(calibration.transform("lidar", "laser"), calibration["laser"].T_root_sensor)


def test_it_maps_points_between_any_two_sensors(calibration: Calibration, rng: np.random.Generator) -> None:
    points_root = rng.normal(size=(10, 3))
    T_root_camera, T_root_laser = (calibration[name].T_root_sensor for name in ("camera", "laser"))
    in_camera = se3.apply(se3.inverse(T_root_camera), points_root)
    in_laser = se3.apply(se3.inverse(T_root_laser), points_root)
    np.testing.assert_allclose(
        se3.apply(calibration.transform("camera", "laser"), in_laser), in_camera, atol=1e-12
    )


def test_both_directions_are_inverse(calibration: Calibration) -> None:
    there_and_back = calibration.transform("camera", "laser") @ calibration.transform("laser", "camera")
    np.testing.assert_allclose(there_and_back, np.eye(4), atol=1e-12)


def test_a_sensor_to_itself_is_the_identity(calibration: Calibration) -> None:
    np.testing.assert_allclose(calibration.transform("camera", "camera"), np.eye(4), atol=1e-12)


@pytest.mark.parametrize(("a", "b"), [("radar", "lidar"), ("lidar", "radar")])
def test_an_unknown_sensor_is_refused_by_name(calibration: Calibration, a: str, b: str) -> None:
    with pytest.raises(
        InputError, match="no sensor 'radar' in this calibration; it has lidar, camera, camera_2, las"
    ):
        calibration.transform(a, b)


def test_an_unconnected_sensor_is_refused_with_its_reason(calibration: Calibration) -> None:
    with pytest.raises(CalibrationError, match=r"'sonar' has no pose: nothing connects it to 'lidar' \(never saw"):
        calibration.transform("lidar", "sonar")


def test_lookup_of_an_unknown_sensor_is_an_error(calibration: Calibration) -> None:
    with pytest.raises(InputError, match="no sensor 'radar'"):
        calibration["radar"]

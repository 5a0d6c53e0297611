"""The section of systematic parameters: each against its prior."""

import re

import numpy as np
import pytest

from calgraph.report.systematic_view import render_systematic_parameters
from calgraph.result import Calibration, EstimatedParameter, join_covariances
from calgraph.result.sensor_pose import SensorPose, Verdict


def render(value: float, stddev: float = 0.5) -> str:
    pose = SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good"))
    one = EstimatedParameter("lidar", "range bias", "mm", 0.0, 1.0, value, stddev)
    return render_systematic_parameters(
        Calibration("lidar", (pose,), join_covariances([np.zeros((6, 6))]), systematic=(one,))
    )


def test_without_parameters_there_is_no_section() -> None:
    pose = SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good"))
    assert render_systematic_parameters(Calibration("lidar", (pose,), join_covariances([np.zeros((6, 6))]))) == ""


@pytest.mark.parametrize(("value", "place"), [(0.0, 66.0), (2.0, 99.0), (9.0, 132.0), (-9.0, 0.0)])
def test_an_estimate_is_drawn_at_its_deviation_from_the_stated_value(value: float, place: float) -> None:
    (drawn,) = re.findall(r'<circle cx="([-\d.]+)"', render(value))
    assert float(drawn) == place


def test_the_deviation_is_also_text() -> None:
    assert "+2.0 ± 0.5 prior standard deviations" in render(2.0)

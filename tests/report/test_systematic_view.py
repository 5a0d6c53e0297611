"""The section of systematic parameters: each against its prior."""

import re

import numpy as np
import pytest

from calgraph.config import Intrinsics
from calgraph.report.systematic_view import render_systematic_parameters
from calgraph.result import Calibration, EstimatedParameter, Evidence, join_covariances
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


def test_estimated_intrinsics_are_stated_with_the_error_of_their_model() -> None:
    intrinsics = Intrinsics(
        width=640, height=480, K=(320.0, 320.0, 319.5, 239.5), estimated_from_views=17, model_error=0.21
    )
    pose = SensorPose("cam", None, "cam", "camera", np.eye(4), Verdict("good"), intrinsics=intrinsics)
    one = EstimatedParameter("cam", "focal length", "px", 320.0, 160.0, 321.4, 0.9)
    remark = "the intrinsics of cam are not well determined: take more views"
    text = render_systematic_parameters(
        Calibration("cam", (pose,), join_covariances([np.zeros((6, 6))]), (one,), Evidence(remarks=(remark,)))
    )
    assert "<h3>Intrinsics of cam</h3>\n<p>Estimated from 17 views" in text
    # Half a right angle to either side, and atan(239.5 / 320) up and down.
    assert "a field of view of 90° by 74°. Error of the lens's model (RMS): 0.21 px" in text
    assert f"<li>{remark}</li>" in text

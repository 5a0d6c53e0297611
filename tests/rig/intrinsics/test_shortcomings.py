"""Intrinsics that are used, with or without a remark, by the standard deviations of their parameters."""

import numpy as np
import pytest

from calgraph.config.settings import IntrinsicsSettings
from calgraph.errors import Rejected
from calgraph.rig.intrinsics.estimate import ViewCoverage, describe_shortcomings
from calgraph.rig.intrinsics.lens_fit import LensFit
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 640, 480, np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]), np.zeros(0))
EVERYWHERE = ViewCoverage(cells=1.0, reach=1.0, tilt=float(np.radians(40)))


def judge(focal: float, center: float) -> tuple[str, ...] | Rejected:
    """Of a focal length of 400 px in an image with a diagonal of 800 px, by standard deviations, px."""
    covariance = np.diag([focal, focal, center, center]) ** 2
    settings = IntrinsicsSettings(good_border_error=1e3)
    return describe_shortcomings(LensFit(CAMERA, covariance, 0.1, {}), EVERYWHERE, settings)


@pytest.mark.parametrize(
    ("focal", "center", "used"), [(11.9, 1.0, True), (12.1, 1.0, False), (1.0, 23.9, True), (1.0, 24.1, False)]
)
def test_intrinsics_are_used_up_to_three_percent(focal: float, center: float, used: bool) -> None:
    """Of the focal length, and of the diagonal for the principal point."""
    assert isinstance(judge(focal, center), Rejected) != used


def test_the_reason_states_the_standard_deviations_and_what_to_do() -> None:
    rejected = judge(13.0, 2.0)
    assert isinstance(rejected, Rejected)
    assert rejected.reason == (
        "its views do not determine its intrinsics (focal length 400 ± 13 px, principal point ± 2 px, σ): "
        "take more views, with the board near enough to fill a third of the image"
    )

"""The noise of a camera's corners, estimated from the residuals of all its boards."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, Detection, Segment
from calgraph.config import PixelNoise
from calgraph.geometry import se3, so3
from calgraph.rig.captures.detect import scale_by_measured_noise
from calgraph.rig.detection.from_measurements import board_corners_from_pixels
from calgraph.sensors import CameraModel

STATED = 0.3
FACING = np.diag([1.0, -1, -1])
CAMERA = CameraModel("pinhole", 1280, 960, np.array([[800.0, 0, 640], [0, 800, 480], [0, 0, 1]]), np.zeros(0))
CORNERS = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 4), np.linspace(-0.3, 0.3, 3)), axis=-1).reshape(-1, 2)


def board(rms: float, corners: int = 12) -> BoardCorners:
    return BoardCorners(
        np.zeros((corners, 3)), np.zeros((corners, 2)), np.eye(4), np.eye(6), np.ones(4), np.eye(3), rms
    )


def scales(rms: Sequence[float], corners: int = 12) -> list[float]:
    """The factors of the covariances of boards with these residuals."""
    found = {i: (board(r, corners),) for i, r in enumerate(rms)}
    factors = []
    for (detection,) in scale_by_measured_noise(found, STATED).values():
        assert isinstance(detection, BoardCorners)
        np.testing.assert_allclose(detection.plane_covariance, detection.covariance[0, 0] * np.eye(3))
        np.testing.assert_allclose(detection.covariance, detection.covariance[0, 0] * np.eye(6))
        factors.append(float(detection.covariance[0, 0]))
    return factors


def test_covariances_are_scaled_to_the_variance_of_all_residuals() -> None:
    # Three boards of 24 residuals and 6 unknowns each: the variance is 72 x 0.1² / 54.
    assert scales([0.1, 0.1, 0.1]) == pytest.approx([0.72 / 54 / STATED**2] * 3)


def test_a_board_with_larger_residuals_keeps_its_own_variance() -> None:
    variance = 24 * (0.1**2 + 0.1**2 + 0.6**2) / 54
    assert scales([0.1, 0.1, 0.6]) == pytest.approx([variance / STATED**2] * 2 + [1.0])


def test_noise_is_not_estimated_below_that_of_the_distortion_model() -> None:
    assert scales([0.01, 0.01]) == pytest.approx([0.05**2 / STATED**2] * 2)


def test_too_few_residuals_leave_covariances_as_stated() -> None:
    # Two boards of 8 corners have 20 degrees of freedom, of 9 corners 24.
    assert scales([0.1, 0.1], corners=8) == [1.0, 1.0]
    assert scales([0.1, 0.1], corners=9) == pytest.approx([36 * 0.01 / 24 / STATED**2] * 2)


def test_the_noise_has_a_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.rig.captures.detect._MIN_NOISE", 0.2)
    monkeypatch.setattr("calgraph.rig.captures.detect._MIN_DEGREES_OF_FREEDOM", 4)
    (scaled,) = scale_by_measured_noise({0: (board(0.1, corners=5),)}, STATED)[0]
    assert isinstance(scaled, BoardCorners)
    assert scaled.covariance[0, 0] == pytest.approx(0.2**2 / STATED**2)


def test_other_detections_stay_as_they_are() -> None:
    segment = Segment(np.zeros((2, 3)), np.eye(6), np.zeros(0), np.zeros((0, 3)))
    found: dict[int, tuple[Detection, ...]] = {0: (board(0.1), segment), 1: (board(0.1),)}
    assert scale_by_measured_noise(found, STATED)[0][1] is segment


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.9])
def test_scaled_covariances_are_those_of_the_errors(sigma: float, rng: np.random.Generator) -> None:
    """The squared Mahalanobis distance of 150 poses has its expectation, 6, whatever noise is stated."""
    T = se3.pose(so3.exp(np.array([0.3, -0.4, 0.1])) @ FACING, np.array([0.1, -0.2, 2.0]))
    true = CAMERA.project(se3.apply(T, np.column_stack([CORNERS, np.zeros(12)])))
    found: dict[int, tuple[Detection, ...]] = {}
    for capture in range(150):
        pixels = true + rng.normal(0, sigma, true.shape)
        detection = board_corners_from_pixels(CORNERS, pixels, CAMERA, PixelNoise(pixel=STATED))
        assert isinstance(detection, BoardCorners)
        # The expected RMS for all boards, so that none keeps the variance of its own residuals.
        rms = sigma * np.sqrt(18 / 24)
        scale = max(STATED, rms) ** 2 / max(STATED, detection.rms) ** 2
        found[capture] = (replace(detection, covariance=scale * detection.covariance, rms=rms),)
    distances = []
    for (scaled,) in scale_by_measured_noise(found, STATED).values():
        assert isinstance(scaled, BoardCorners)
        error = se3.difference(scaled.T_camera_board, T)
        distances.append(error @ np.linalg.solve(scaled.covariance, error))
    assert np.mean(distances) == pytest.approx(6, rel=0.12)

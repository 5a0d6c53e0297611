"""Intrinsics from views alone: against known cameras, OpenCV, and views that do not suffice."""

import cv2
import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
from calgraph.sensors import CameraModel
from camera_views import FISHEYE, PINHOLE, WIDE, checkerboard_rig, simulate_views

pytestmark = pytest.mark.slow

CAMERAS = {"pinhole": PINHOLE, "wide": WIDE, "fisheye": FISHEYE}
RIG = checkerboard_rig()


def estimate(views: list[BoardView], rig: Rig = RIG) -> IntrinsicsEstimate:
    found = estimate_intrinsics(rig, "camera", views)
    assert isinstance(found, IntrinsicsEstimate), found.reason
    return found


def reject(views: list[BoardView]) -> str:
    found = estimate_intrinsics(RIG, "camera", views)
    assert isinstance(found, Rejected)
    return found.reason


@pytest.mark.parametrize("kind", CAMERAS)
def test_the_camera_is_found_without_start_values(kind: str) -> None:
    truth = CAMERAS[kind]
    found = estimate(simulate_views(truth, 3, 15))
    assert found.camera.model == truth.model
    np.testing.assert_allclose(found.camera.focal, truth.focal, rtol=0.003)
    np.testing.assert_allclose(found.camera.principal_point, truth.principal_point, atol=1)
    assert found.noise == pytest.approx(0.2, rel=0.1)
    assert found.shortcomings == ()


@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
def test_errors_are_as_large_as_the_covariance_states(kind: str) -> None:
    truth = CAMERAS[kind]
    squares = []
    for seed in range(10, 14):
        found = estimate(simulate_views(truth, seed, 12))
        error = found.camera.intrinsics - truth.intrinsics
        squares.append(error @ np.linalg.solve(found.covariance, error) / len(error))
    # 95 % of the mean of 4 NEES of 8 or 9 parameters.
    assert 0.56 < np.mean(squares) < 1.6


def test_a_pinhole_is_that_of_opencv() -> None:
    views = simulate_views(PINHOLE, 5, 15)
    found = estimate(views)
    corners = [view.flat_corners.astype(np.float32) for view in views]
    pixels = [view.flat_pixels.astype(np.float32) for view in views]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 500, 1e-12)
    _, K, D, _, _ = cv2.calibrateCamera(corners, pixels, (1280, 960), np.eye(3), np.zeros(5), criteria=criteria)
    reference = CameraModel("pinhole", 1280, 960, np.asarray(K, dtype=float), np.asarray(D, dtype=float))
    # Both minimise the same errors, except for our robust loss.
    difference = found.camera.intrinsics - reference.intrinsics
    assert np.abs(difference / found.stddev).max() < 0.3


def test_a_fisheye_is_that_of_opencv() -> None:
    # OpenCV undistorts corners to z = 1 at first, so they must be less than 90 degrees from the axis.
    views = [
        v for v in simulate_views(FISHEYE, 6, 20, extent=0.5) if np.abs(v.flat_pixels - [655, 470]).max() < 420
    ]
    found = estimate(views)
    corners = [view.flat_corners[None] for view in views]
    pixels = [view.flat_pixels[None] for view in views]
    flags = (
        cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
    )
    _, K, D, _, _ = cv2.fisheye.calibrate(
        corners, pixels, (1280, 960), FISHEYE.K.copy(), np.zeros((4, 1)), flags=flags,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-9),
    )  # fmt: skip
    reference = CameraModel("fisheye", 1280, 960, np.asarray(K, dtype=float), np.ravel(D).astype(float))
    assert np.abs((found.camera.intrinsics - reference.intrinsics) / found.stddev).max() < 0.3


def test_outlier_corners_change_little() -> None:
    found = estimate(simulate_views(PINHOLE, 7, 15, outliers=0.05))
    assert np.abs((found.camera.intrinsics - PINHOLE.intrinsics) / found.stddev).max() < 3.5
    assert found.noise == pytest.approx(0.2, rel=0.15)


def test_a_view_of_another_board_is_left_out() -> None:
    views = simulate_views(PINHOLE, 8, 15)
    mirrored = views[4]
    views[4] = BoardView(mirrored.ids, mirrored.corners, mirrored.pixels[::-1], mirrored.size)
    views[9] = BoardView(views[9].ids, views[9].corners[:, :, [1, 0, 2]], views[9].pixels, views[9].size)
    found = estimate(views)
    assert 13 <= len(found.detections) <= 14
    np.testing.assert_allclose(found.camera.focal, PINHOLE.focal, rtol=0.003)


def test_a_stated_model_is_used() -> None:
    found = estimate_intrinsics(RIG, "camera", simulate_views(PINHOLE, 9, 10), "fisheye")
    assert isinstance(found, IntrinsicsEstimate)
    assert found.camera.model == "fisheye"
    assert found.rejected_models == {}


def test_the_model_that_was_not_chosen_is_named_with_its_fit() -> None:
    found = estimate(simulate_views(WIDE, 9, 10))
    assert set(found.rejected_models) == {"fisheye"}
    assert 0.2 < float(found.rejected_models["fisheye"].removesuffix(" px")) < 1


def test_too_few_views_are_named_with_what_to_do() -> None:
    assert reject(simulate_views(PINHOLE, 1, 4)).startswith(
        "4 images with at least 8 corners of the board do not determine its intrinsics, which need 5"
    )


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
def test_boards_that_face_the_camera_do_not_determine_a_focal_length(kind: str, seed: int) -> None:
    # Parallel to the image, not across the line of sight: there, perspective shows.
    views = simulate_views(CAMERAS[kind], seed, 12, tilt=1.0, extent=0.05)
    reason = reject(views)
    assert "do not determine its intrinsics (focal length " in reason
    assert "tilt the board by 30 to 45 degrees" in reason


def test_corners_in_the_middle_only_leave_the_border_uncertain() -> None:
    views = simulate_views(PINHOLE, 2, 30, extent=0.25)
    small = [v for v in views if np.abs(v.flat_pixels - [640, 480]).max(axis=0).max() < 330]
    found = estimate_intrinsics(RIG, "camera", small)
    if isinstance(found, IntrinsicsEstimate):
        assert any("the projection at the border of the image is uncertain" in one for one in found.shortcomings)
        error = np.abs((found.camera.intrinsics - PINHOLE.intrinsics) / found.stddev)
        assert error.max() < 4


def test_views_of_images_of_several_sizes_are_rejected() -> None:
    views = simulate_views(PINHOLE, 2, 10)
    half = BoardView(views[0].ids, views[0].corners, views[0].pixels / 2, (640, 480))
    assert reject([half, *views[1:]]) == "its images differ in size: 640x480, 1280x960"


def test_of_many_views_the_most_different_ones_are_used() -> None:
    views = simulate_views(PINHOLE, 4, 30)
    few = Rig.model_validate({
        **RIG.to_plain(), "settings": {"estimation": {"intrinsics": {"max_views": 15}}},
    })  # fmt: skip
    found = estimate([*views[:10], *[views[9]] * 20, *views[10:]], few)
    assert found.views == 15
    np.testing.assert_allclose(found.camera.focal, PINHOLE.focal, rtol=0.003)

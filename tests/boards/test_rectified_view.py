"""Rectified views of tags."""

import cv2
import numpy as np
import pytest

from calgraph.boards.tags import is_undistorted, rectify_view
from calgraph.config.settings import TagSettings
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

K = np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]])
PLAIN = CameraModel("pinhole", 640, 480, K, np.zeros(0))
BARREL = CameraModel("pinhole", 640, 480, K, np.array([-0.25, 0.05, 0.001, -0.001]))
FISHEYE = CameraModel("fisheye", 640, 480, K, np.array([0.02, -0.005, 0.001, 0.0]))
SETTINGS = TagSettings()


def square(center: tuple[float, float, float], edge: float = 0.3) -> Array:
    """Corners (1, 4, 3) of an upright square, camera frame."""
    return np.array([[[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]]) * edge / 2 + center


@pytest.mark.parametrize(("camera", "straight"), [(PLAIN, True), (BARREL, False), (FISHEYE, False)])
def test_only_a_pinhole_without_distortion_is_undistorted(camera: CameraModel, straight: bool) -> None:
    assert is_undistorted(camera) == straight


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
@pytest.mark.parametrize("center", [(0.0, 0.0, 2.0), (0.9, -0.5, 1.5), (-0.4, 0.2, 0.6)])
def test_lines_between_corners_are_straight_in_the_view(
    camera: CameraModel, center: tuple[float, float, float]
) -> None:
    corners = square(center)
    view = rectify_view(np.zeros((480, 640), np.uint8), camera, corners)
    assert view is not None
    ray = corners[0] @ view.R_camera_view
    pixels = view.focal * (ray[:, :2] / ray[:, 2:] - view.corner)
    np.testing.assert_allclose(view.to_image(pixels), camera.project(corners[0]), atol=1e-9)
    middle = 0.5 * (corners[0, 0] + corners[0, 1])
    ray = middle @ view.R_camera_view
    on_line = view.focal * (ray[:2] / ray[2] - view.corner)
    a, b = pixels[1] - pixels[0], on_line - pixels[0]
    assert abs(a[0] * b[1] - a[1] * b[0]) / np.linalg.norm(a) < 1e-9


def test_the_view_is_upright_and_points_at_the_tags() -> None:
    for center in ((0.0, 0.0, 2.0), (0.8, -0.4, 1.5), (-1.0, 0.5, 1.0)):
        view = rectify_view(np.zeros((480, 640), np.uint8), FISHEYE, square(center))
        assert view is not None
        R = view.R_camera_view
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        np.testing.assert_allclose(R[:, 2], np.array(center) / np.linalg.norm(center), atol=0.02)
        # Its x axis is horizontal, its y axis down.
        assert abs(R[1, 0]) < 1e-12
        assert R[1, 1] > 0.5


def test_scale_and_margin_are_those_of_the_settings() -> None:
    view = rectify_view(np.zeros((480, 640), np.uint8), PLAIN, square((0.0, 0.0, 2.0)))
    assert view is not None
    # A tag of 0.3 m at 2 m has 45 px; in the view 67.5 px, and a margin of 0.4 edges on either side.
    assert view.focal == pytest.approx(1.5 * 300)
    assert view.image.shape == pytest.approx((67.5 * 1.8, 67.5 * 1.8), abs=2)
    np.testing.assert_allclose(view.corner, [-0.135, -0.135], atol=1e-9)


def test_gray_values_are_those_of_the_image(rng: np.random.Generator) -> None:
    noise = rng.integers(0, 255, (480, 640)).astype(np.uint8)
    image = np.asarray(cv2.GaussianBlur(noise, (0, 0), 6), dtype=np.uint8)
    view = rectify_view(image, BARREL, square((0.6, -0.3, 1.5)))
    assert view is not None
    v, u = (a.ravel() for a in np.indices(view.image.shape))
    x, y = view.to_image(np.column_stack([u, v]).astype(float)).T
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    off = view.image.ravel().astype(int) - image[row, column]
    assert np.abs(off).max() <= 4
    assert abs(off.mean()) < 0.3


def test_tags_over_too_wide_an_angle_have_no_view() -> None:
    wide = np.concatenate([square((-3.0, 0.0, 0.5)), square((3.0, 0.0, 0.5))])
    assert rectify_view(np.zeros((480, 640), np.uint8), FISHEYE, wide) is None
    around = np.concatenate([square((-1.0, 0.0, -0.5)), square((1.0, 0.0, 1.0))])
    assert rectify_view(np.zeros((480, 640), np.uint8), FISHEYE, around) is None

"""Fields of view and uncertainties."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calgraph.geometry import se3
from calgraph.sensors import CameraModel
from calgraph.viewer.scene_display import frustum_shape, rectify_image, sample_beams, uncertainty_ellipsoid


def camera(model: str, distortion: tuple[float, ...], center: tuple[float, float] = (319.5, 239.5)) -> CameraModel:
    K = np.array([[400, 0, center[0]], [0, 400, center[1]], [0, 0, 1]], dtype=float)
    return CameraModel("fisheye" if model == "fisheye" else "pinhole", 640, 480, K, np.array(distortion))


def test_a_frustum_is_as_wide_as_the_image() -> None:
    angle, aspect = frustum_shape(camera("pinhole", ()))
    assert angle == pytest.approx(2 * np.arctan(240 / 400))
    assert aspect == pytest.approx(640 / 480)


def test_a_fisheye_frustum_is_clipped() -> None:
    wide = CameraModel("fisheye", 1000, 1000, np.diag([100.0, 100, 1]), np.zeros(4))
    assert frustum_shape(wide) == pytest.approx((np.radians(130), 1.0))


@pytest.mark.parametrize(
    "lens",
    [
        camera("pinhole", ()),
        camera("pinhole", (-0.25, 0.08, 0.001, -0.002)),
        camera("pinhole", (), (300.0, 260.0)),
        camera("fisheye", (0.02, -0.01, 0.003, 0.0)),
    ],
)
def test_rectification_gives_a_pinhole_image(lens: CameraModel) -> None:
    """A spot drawn in the direction (0.2, -0.1, 1) through the lens appears there in the rectified image."""
    u, v = lens.project(np.array([[0.2, -0.1, 1]]))[0]
    y, x = np.mgrid[:480, :640]
    spot = (255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 50)).astype(np.uint8)
    shown = rectify_image(np.dstack([spot] * 3), lens, 640)[..., 0].astype(float)
    rows, columns = np.mgrid[: shown.shape[0], : shown.shape[1]]
    at = np.array([np.sum(shown * columns), np.sum(shown * rows)]) / shown.sum()
    angle, aspect = frustum_shape(lens)
    half = np.tan(angle / 2) * np.array([aspect, 1])
    expected = (np.array([0.2, -0.1]) / half + 1) / 2 * shown.shape[::-1] - 0.5
    np.testing.assert_allclose(at, expected, atol=0.6)


def test_a_shrunk_image_is_rectified_alike() -> None:
    lens = camera("pinhole", (-0.2, 0.05, 0, 0))
    large = np.dstack([np.tile(np.linspace(0, 255, 640), (480, 1))] * 3).astype(np.uint8)
    a, b = (rectify_image(np.ascontiguousarray(p), lens, 160).astype(int) for p in (large, large[::2, ::2]))
    assert np.abs(a - b)[5:-5, 5:-5].max() <= 2


@pytest.mark.parametrize("count", [0, 1, 50, 1081])
def test_beams_are_few_and_spread(count: int) -> None:
    points = np.column_stack([np.arange(count), np.zeros((count, 2))]).astype(np.float32)
    found = sample_beams(points)
    assert len(found) <= 45
    assert len(found) >= min(count, 22)
    assert not found[:, 0].any()


def test_an_ellipsoid_holds_95_percent(rng: np.random.Generator) -> None:
    """Of errors drawn in the root's axes, in the sensor frame."""
    root = rng.normal(0, 1, (6, 6))
    covariance = 1e-4 * root @ root.T
    T = se3.pose(Rotation.random(random_state=3).as_matrix(), np.array([1, 2, 3.0]))
    half, R = uncertainty_ellipsoid(T, covariance, 99)
    errors = rng.multivariate_normal(np.zeros(6), covariance, 100_000)[:, :3] @ T[:3, :3]
    inside = np.sum((errors @ R / half) ** 2, axis=1) < 1
    # Three standard deviations of a share of 0.95 among 100,000.
    assert inside.mean() == pytest.approx(0.95, abs=0.0021)
    assert np.linalg.det(R) == pytest.approx(1)


def test_unobservable_directions_are_clipped() -> None:
    half, _ = uncertainty_ellipsoid(np.eye(4), np.diag([np.inf, np.nan, 1e-6, 1, 1, 1]), 0.5)
    assert half.max() == 0.5
    assert np.isfinite(half).all()

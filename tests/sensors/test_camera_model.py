"""Camera models against OpenCV, against numerical derivatives, and beyond the limits of their polynomials."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

K = np.array([[702.0, 0, 641.3], [0, 698.0, 477.2], [0, 0, 1]])

# Lenses as calibrated: none, wide-angle, two phones, a rational one, an over-fitted one, two fisheyes.
LENSES = {
    "none": CameraModel("pinhole", 1280, 960, K, np.zeros(0)),
    "barrel": CameraModel("pinhole", 1280, 960, K, np.array([-0.3, 0.1, 0.001, -0.002])),
    "pincushion": CameraModel("pinhole", 1280, 960, K, np.array([0.18, -0.31, -0.0004, 0.0004, -0.08])),
    "rational": CameraModel("pinhole", 1280, 960, K, np.array([0.5, -0.2, 1e-3, 1e-3, 0.05, 0.8, -0.1, 0.02])),
    "overfitted": CameraModel("pinhole", 1280, 960, K, np.array([0.2, -0.5, 0.001, 0.002, -1.095])),
    "fisheye": CameraModel("fisheye", 1280, 960, K, np.array([-0.054, -0.0784, 0.096, -0.0515])),
    "wide fisheye": CameraModel(
        "fisheye", 1280, 960, np.array([[300.0, 0, 640], [0, 300, 480], [0, 0, 1]]), np.zeros(4)
    ),
}
any_lens = pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES.keys())


def opencv_pixels(camera: CameraModel, points: Array) -> Array:
    zero = np.zeros(3)
    if camera.model == "fisheye":
        D = camera.distortion if len(camera.distortion) else np.zeros(4)
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, D)
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, camera.K, camera.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def pixel_grid(camera: CameraModel) -> Array:
    """Pixels all over an image, its outer border included."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 81), np.linspace(-0.5, camera.height - 0.5, 61)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


coefficient = st.floats(-0.3, 0.3)
small = st.floats(-0.003, 0.003)
pinholes = st.one_of(
    st.just([]),
    st.tuples(coefficient, coefficient, small, small),
    st.tuples(coefficient, coefficient, small, small, coefficient),
    st.tuples(coefficient, coefficient, small, small, coefficient, coefficient, coefficient, coefficient),
).map(lambda D: ("pinhole", np.array(D)))
fisheyes = st.tuples(*[st.floats(-0.1, 0.1)] * 4).map(lambda D: ("fisheye", np.array(D)))


@st.composite
def cameras(draw: st.DrawFn) -> CameraModel:
    model, distortion = draw(st.one_of(pinholes, fisheyes))
    fx, fy = draw(st.floats(100, 3000)), draw(st.floats(100, 3000))
    intrinsics = np.array([[fx, 0, draw(st.floats(0, 2000))], [0, fy, draw(st.floats(0, 2000))], [0, 0, 1]])
    return CameraModel(model, 1280, 960, intrinsics, distortion)


def scene(seed: int) -> Array:
    """Points in front of a camera, up to 60° off its axis."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.2, 20, 60)
    return np.stack([rng.uniform(-1.7, 1.7, 60) * z, rng.uniform(-1.7, 1.7, 60) * z, z], axis=-1)


@settings(max_examples=60, deadline=None)
@given(cameras(), st.integers(0, 1000))
def test_agrees_with_opencv_wherever_it_answers(camera: CameraModel, seed: int) -> None:
    points = scene(seed)
    pixels = camera.project(points)
    answered = np.isfinite(pixels).all(axis=1)
    np.testing.assert_allclose(pixels[answered], opencv_pixels(camera, points)[answered], rtol=1e-9, atol=1e-7)


@settings(max_examples=60, deadline=None)
@given(cameras(), st.integers(0, 1000))
def test_jacobian_is_the_derivative(camera: CameraModel, seed: int) -> None:
    points = scene(seed)
    pixels, J = camera.project_with_jacobian(points)
    h = 1e-6 * points[:, 2:]
    numeric = np.stack(
        [(camera.project(points + h * e) - camera.project(points - h * e)) / (2 * h) for e in np.eye(3)], axis=-1
    )
    # Curvature grows without bound as a pole of the rational polynomial comes near.
    tame = np.isfinite(numeric).all(axis=(1, 2)) & (np.abs(pixels).max(axis=1) < 1e5)
    scale = np.abs(J[tame]).max(axis=(1, 2), initial=1, keepdims=True)
    np.testing.assert_allclose(J[tame] / scale, numeric[tame] / scale, atol=2e-5)


@any_lens
def test_jacobian_exists_on_the_axis(camera: CameraModel) -> None:
    _, J = camera.project_with_jacobian(np.array([[0, 0, 2.0]]))
    np.testing.assert_allclose(J[0], np.column_stack([np.diag(camera.focal) / 2, np.zeros(2)]), atol=1e-12)


@any_lens
def test_every_ray_projects_back_to_its_pixel(camera: CameraModel) -> None:
    pixels = pixel_grid(camera)
    rays = camera.rays(pixels)
    found = np.isfinite(rays).all(axis=1)
    np.testing.assert_allclose(camera.project(rays[found]), pixels[found], atol=1e-9)


@any_lens
def test_rays_have_unit_length(camera: CameraModel) -> None:
    rays = camera.rays(pixel_grid(camera))
    found = np.isfinite(rays).all(axis=1)
    np.testing.assert_allclose(np.linalg.norm(rays[found], axis=1), 1, atol=1e-14)


@pytest.mark.parametrize("name", ["none", "barrel", "rational", "wide fisheye"])
def test_monotonic_lenses_have_rays_in_the_whole_image(name: str) -> None:
    camera = LENSES[name]
    assert np.isfinite(camera.rays(pixel_grid(camera))).all()


def test_pixels_that_no_point_reaches_have_no_ray() -> None:
    camera = LENSES["overfitted"]
    assert np.isnan(camera.rays(np.array([[0.0, 0.0], [1279, 959]]))).all()


@any_lens
def test_directions_outside_the_field_of_view_stay_outside_the_image(
    camera: CameraModel, rng: np.random.Generator
) -> None:
    points = rng.normal(size=(50_000, 3)) * [5, 5, 1]
    pixels = camera.project(points)
    drawn = camera.contains(pixels)
    directions = points[drawn] / np.linalg.norm(points[drawn], axis=1, keepdims=True)
    # Each pixel belongs to one direction only: a second one would be beyond the monotonic range.
    np.testing.assert_allclose(camera.rays(pixels[drawn]), directions, atol=1e-7)


def test_a_point_beyond_the_monotonic_range_is_not_projected() -> None:
    camera, point = LENSES["overfitted"], np.array([[0.85, 0.0, 1.0]])
    assert camera.contains(opencv_pixels(camera, point)).all()
    assert np.isnan(camera.project(point)).all()


@pytest.mark.parametrize("point", [[0, 0, -1.0], [0, 0, 0], [1, 0, 0], [1, 1, -0.1], [np.nan, 0, 1]])
def test_pinhole_projects_no_point_beside_or_behind_it(point: list[float]) -> None:
    assert np.isnan(LENSES["barrel"].project(np.array([point]))).all()


def test_wide_fisheye_projects_beyond_ninety_degrees() -> None:
    pixels = LENSES["wide fisheye"].project(np.array([[np.sin(1.7), 0, np.cos(1.7)]]))
    np.testing.assert_allclose(pixels, [[640 + 300 * 1.7, 480]], atol=1e-9)


@pytest.mark.parametrize("degrees", [70, 85, 89])
def test_pinhole_projects_up_to_ninety_degrees(degrees: float) -> None:
    direction = np.array([[np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))]])
    pixels = LENSES["none"].project(direction)
    np.testing.assert_allclose(pixels, [[641.3 + 702 * np.tan(np.radians(degrees)), 477.2]])
    np.testing.assert_allclose(LENSES["none"].rays(pixels), direction, atol=1e-9)


@pytest.mark.parametrize(("outside", "exists"), [(-0.005, True), (0.005, False)])
def test_pixels_just_beyond_the_monotonic_range_have_no_ray(outside: float, exists: bool) -> None:
    camera = CameraModel("fisheye", 1280, 960, K, np.array([-0.054, -0.0784, 0.096, -0.0515]))
    theta = np.linspace(0, 2, 2_000_001)
    profile = theta * (1 - 0.054 * theta**2 - 0.0784 * theta**4 + 0.096 * theta**6 - 0.0515 * theta**8)
    radius = 702 * profile.max()
    rays = camera.rays(np.array([[641.3 + radius + outside, 477.2]]))
    assert np.isfinite(rays).all() == exists


def test_image_reaches_to_the_outer_edge_of_its_border_pixels() -> None:
    pixels = np.array([[-0.5, 0], [-0.6, 0], [1279.4, 959.4], [1279.5, 3], [np.nan, 3]])
    assert LENSES["none"].contains(pixels).tolist() == [True, False, True, False, False]


def test_no_points_have_no_pixels() -> None:
    assert LENSES["fisheye"].project(np.zeros((0, 3))).shape == (0, 2)


def test_no_pixels_have_no_rays() -> None:
    assert LENSES["barrel"].rays(np.zeros((0, 2))).shape == (0, 3)


def test_zero_thin_prism_and_tilt_terms_are_dropped() -> None:
    rational = LENSES["rational"].distortion
    assert CameraModel("pinhole", 1280, 960, K, np.pad(rational, (0, 6))).distortion.tolist() == rational.tolist()


@pytest.mark.parametrize(
    ("model", "distortion"), [("pinhole", np.ones(12)), ("pinhole", np.ones(3)), ("fisheye", np.ones(5))]
)
def test_unsupported_coefficients_are_refused(model: str, distortion: Array) -> None:
    with pytest.raises(InputError, match=f"distortion of a {model} camera"):
        CameraModel(model, 1280, 960, K, distortion)  # type: ignore[arg-type]

"""Lenses that no model describes: the size of what it lacks, and stated errors that hold all the same."""

from functools import cache

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
from calgraph.rig.intrinsics.lens_fit import estimate_model_error
from camera_views import FISHEYE, PINHOLE, WIDE, checkerboard_rig, simulate_views

pytestmark = pytest.mark.slow

CAMERAS = {"pinhole": PINHOLE, "wide": WIDE, "fisheye": FISHEYE}
RIG = checkerboard_rig()


def bump(pixels: Array, size: float) -> Array:
    """Displacements of up to 0.9 of ``size`` around two places of the image, 250 px wide."""
    places = np.array([[350, 250], [900, 640]])
    heights = np.exp(-0.5 * np.sum((pixels[:, None] - places) ** 2, axis=-1) / 250**2)
    return np.asarray(size * heights @ np.array([[0.8, -0.4], [-0.3, 0.8]]))


@cache
def estimate(kind: str, size: float, seed: int = 3) -> IntrinsicsEstimate:
    views = [
        BoardView(view.ids, view.corners, view.pixels + bump(view.flat_pixels, size)[:, None], view.size)
        for view in simulate_views(CAMERAS[kind], seed, 12)
    ]
    found = estimate_intrinsics(RIG, "camera", views)
    assert isinstance(found, IntrinsicsEstimate), found.reason
    return found


@pytest.mark.parametrize("kind", CAMERAS)
def test_the_model_is_found_where_the_lens_is_none(kind: str) -> None:
    assert estimate(kind, 1.0).camera.model == CAMERAS[kind].model


@pytest.mark.parametrize("kind", CAMERAS)
def test_errors_are_as_large_as_stated_where_the_lens_is_of_no_model(kind: str) -> None:
    found, truth = estimate(kind, 1.0), CAMERAS[kind]
    error = found.camera.intrinsics - truth.intrinsics
    # 8 or 9 parameters; without the error of the model it is 20 to 100.
    assert error @ np.linalg.solve(found.covariance, error) / len(error) < 3


def test_the_error_of_the_model_is_found() -> None:
    grid = np.stack(np.meshgrid(np.arange(0.0, 1280, 20), np.arange(0.0, 960, 20)), axis=-1).reshape(-1, 2)
    size = np.sqrt(np.mean(np.square(bump(grid, 1.0))))
    found = estimate("pinhole", 1.0)
    # The model explains a part of the displacements.
    assert 0.3 * size < found.model_error < 1.2 * size
    assert found.to_intrinsics().model_error == found.model_error


def test_an_exact_lens_has_almost_no_error_of_its_model() -> None:
    assert estimate("pinhole", 0.0).model_error < 0.06


def field_equations(variance: float, seed: int) -> tuple[Array, Array, float, int]:
    """Those of 500 residuals with unit noise and a field of 20 coefficients."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(500, 20))
    residual = J @ rng.normal(size=20) * np.sqrt(variance) + rng.normal(size=500)
    return J.T @ J, J.T @ residual, float(residual @ residual), 500


@pytest.mark.parametrize("variance", [0.01, 0.25, 9.0])
def test_variances_of_field_and_noise(variance: float) -> None:
    found = [estimate_model_error(*field_equations(variance, seed)) for seed in range(30)]
    assert np.mean([one.field for one in found]) == pytest.approx(variance, rel=0.25)
    assert np.mean([one.noise for one in found]) == pytest.approx(1, rel=0.05)


def test_the_deviance_is_that_of_a_normal_distribution() -> None:
    rng = np.random.default_rng(0)
    J, residual = rng.normal(size=(6, 2)), rng.normal(size=6)
    found = estimate_model_error(J.T @ J, J.T @ residual, float(residual @ residual), 6)
    deviances = []
    for ratio in np.append(0.0, np.geomspace(0.02, 100, 150) ** 2):
        V = np.eye(6) + ratio * J @ J.T
        variance = residual @ np.linalg.solve(V, residual) / 6
        deviances.append(np.linalg.slogdet(variance * V)[1] + 6)
    assert found.deviance == pytest.approx(min(deviances))


def test_waves_along_the_radius_are_no_error_of_the_intrinsics() -> None:
    views = []
    for view in simulate_views(PINHOLE, 3, 12):
        away = (view.pixels - PINHOLE.principal_point) / 800
        radius = np.linalg.norm(away, axis=-1, keepdims=True)
        views.append(BoardView(view.ids, view.corners, view.pixels + np.sin(21 * radius) * away, view.size))
    found = estimate_intrinsics(RIG, "camera", views)
    assert isinstance(found, IntrinsicsEstimate), found.reason
    assert found.camera.model == "pinhole"
    error = found.camera.intrinsics - PINHOLE.intrinsics
    assert error @ np.linalg.solve(found.covariance, error) / len(error) < 3

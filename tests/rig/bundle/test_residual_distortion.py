"""The field of what a lens displaces beyond its model."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.rig.bundle.residual_distortion import ResidualDistortion
from camera_views import PINHOLE

FIELD = ResidualDistortion.over_images(PINHOLE)
RNG_SEED = 3


def draw(seed: int = RNG_SEED) -> tuple[Array, Array]:
    """Pixels (200, 2) over the image, and coefficients of a field of 1 px."""
    rng = np.random.default_rng(seed)
    return rng.uniform([0, 0], [1280, 960], (200, 2)), rng.normal(size=FIELD.count) * FIELD.stddev


def test_its_size_is_one_pixel_along_each_axis() -> None:
    squares = [np.square(FIELD.displace(pixels, c)[0] - pixels).mean() for pixels, c in map(draw, range(200))]
    assert np.mean(squares) == pytest.approx(1, rel=0.1)


@pytest.mark.parametrize("axis", [0, 1])
def test_derivatives_by_pixels(axis: int) -> None:
    pixels, coefficients = draw()
    step = 1e-3 * np.eye(2)[axis]
    ahead, behind = (FIELD.displace(pixels + sign * step, coefficients)[0] for sign in (1, -1))
    _, by_pixels, _ = FIELD.displace(pixels, coefficients)
    np.testing.assert_allclose((ahead - behind) / 2e-3, by_pixels[..., axis], atol=1e-8)


def test_derivatives_by_coefficients() -> None:
    pixels, coefficients = draw()
    displaced, _, by_coefficients = FIELD.displace(pixels, coefficients)
    np.testing.assert_allclose(by_coefficients @ coefficients, displaced - pixels, atol=1e-12)


def test_the_radial_part_moves_pixels_away_from_the_principal_point() -> None:
    pixels, coefficients = draw()
    coefficients[: 2 * len(FIELD.frequency)] = 0
    moved, away = FIELD.displace(pixels, coefficients)[0] - pixels, pixels - PINHOLE.principal_point
    assert np.abs(moved).max() > 0.3
    np.testing.assert_allclose(moved[:, 0] * away[:, 1], moved[:, 1] * away[:, 0], atol=1e-9)


def test_neighbours_are_displaced_together() -> None:
    pixels, _ = draw()
    differences = [
        np.square(np.diff([FIELD.displace(pixels + shift, c)[0] - shift for shift in (0.0, 16.0)], axis=0)).mean()
        for _, c in map(draw, range(20))
    ]
    # Of 1600 px; independent displacements differ by 2 px².
    assert np.mean(differences) < 0.2


@pytest.mark.parametrize("periods", [1.5, 2.5, 3.5])
def test_it_has_short_waves_along_the_radius(periods: float) -> None:
    pixels, _ = draw()
    away = (pixels - PINHOLE.principal_point) / 800
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    wave = (np.sin(2 * np.pi * periods * radius) * away).ravel()
    # Least squares with the prior of a field of 1 px, and measurements of 0.02 px.
    J = FIELD.displace(pixels, np.zeros(FIELD.count))[2].reshape(len(wave), -1) * FIELD.stddev
    found = np.linalg.solve(J.T @ J + 0.02**2 * np.eye(FIELD.count), J.T @ wave)
    assert np.std(wave - J @ found) < 0.1 * np.std(wave)

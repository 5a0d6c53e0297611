"""Lines and planes through noisy ranges."""

import numpy as np
import pytest

from calgraph.boards.detections import to_beams
from calgraph.geometry import Array, plane
from calgraph.rig.detection.line_plane_fit import fit_line, fit_plane

LINE = np.array([0.9, 2.0])
BEAMS = np.linspace(-0.2, 0.6, 120)
PLANE = np.array([-0.6, 0.0, -0.8, 2.0])


def line_ranges() -> Array:
    return np.asarray(LINE[1] / np.cos(BEAMS - LINE[0]))


def beams_at_plane(count: int) -> Array:
    """(N, 3) exact points on the plane in beams at up to 70° from its normal."""
    azimuth, elevation = (
        g.ravel() for g in np.meshgrid(np.linspace(-0.5, 0.5, count), np.linspace(0.0, 0.6, count))
    )
    u = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    return np.asarray(u * (-PLANE[3] / (u @ PLANE[:3]))[:, None])


def test_an_exact_line_is_found_exactly() -> None:
    fit = fit_line(BEAMS, line_ranges(), np.full(120, 0.01), np.full(120, 1e-3), LINE + np.array([0.05, -0.03]))
    assert fit is not None
    assert np.allclose(fit.parameters, LINE, atol=1e-9)


def test_outliers_do_not_move_a_line(rng: np.random.Generator) -> None:
    ranges = line_ranges() + rng.normal(0, 0.01, 120)
    ranges[::6] += 0.15
    fit = fit_line(BEAMS, ranges, np.full(120, 0.01), np.full(120, 1e-3), LINE)
    assert fit is not None
    error = fit.parameters - LINE
    assert error @ np.linalg.solve(fit.covariance, error) < 12
    assert not fit.inliers[::6].any()


@pytest.mark.parametrize("share", [0.2, 0.35])
def test_a_third_of_outliers_on_one_side_do_not_move_a_line(share: float, rng: np.random.Generator) -> None:
    outliers = rng.permutation(120) < share * 120
    ranges = line_ranges() + rng.normal(0, 0.01, 120) + 0.2 * outliers
    fit = fit_line(BEAMS, ranges, np.full(120, 0.01), np.full(120, 1e-3), LINE)
    assert fit is not None
    assert not (fit.inliers & outliers).any()
    assert fit.inliers.sum() > 0.95 * (~outliers).sum()
    error = fit.parameters - LINE
    assert error @ np.linalg.solve(fit.covariance, error) < 13.8  # χ²(2), 99.9 %


def test_an_exact_plane_is_found_exactly() -> None:
    start = plane.retract(PLANE, np.array([0.04, -0.03, 0.05]))
    fit = fit_plane(*to_beams(beams_at_plane(12)), 0.01, 1e-3, start)
    assert fit is not None
    assert np.allclose(fit.parameters, PLANE, atol=1e-9)


def test_noise_along_the_beam_does_not_turn_an_inclined_plane() -> None:
    """Where total least squares is biased by several standard deviations, the mean error stays within them."""
    exact = beams_at_plane(25)
    far = np.linalg.norm(exact, axis=1, keepdims=True)
    errors, squares = [], []
    for seed in range(60):
        noisy = exact * (1 + np.random.default_rng(seed).normal(0, 0.03, far.shape) / far)
        fit = fit_plane(*to_beams(noisy), 0.03, 1e-4, PLANE)
        assert fit is not None
        B = plane.tangent_basis(PLANE[:3])
        errors.append(np.append(B.T @ fit.parameters[:3], fit.parameters[3] - PLANE[3]))
        squares.append(np.diag(fit.covariance))
    standard_error = np.sqrt(np.mean(squares, axis=0) / len(errors))
    assert (np.abs(np.mean(errors, axis=0)) < 3.5 * standard_error).all()


def test_too_few_beams_are_no_line() -> None:
    assert fit_line(BEAMS[:2], line_ranges()[:2], np.full(2, 0.01), np.full(2, 1e-3), LINE) is None


def test_a_surface_that_no_beam_intersects_is_none() -> None:
    """Beams of one length fit a line or a plane behind the scanner exactly, where incidence angles are bounded."""
    noise = np.full(120, 0.01), np.full(120, 1e-3)
    assert fit_line(BEAMS, np.full(120, 2.0), *noise, np.array([-2.5, 0.8])) is None
    _, directions = to_beams(beams_at_plane(12))
    assert fit_plane(np.full(144, 2.0), directions, 0.01, 1e-3, np.append(-PLANE[:3], 0.8)) is None


def test_points_on_one_line_are_no_plane() -> None:
    points = np.array([2.0, -1.0, 1.0]) + np.linspace(0, 1, 20)[:, None] * np.array([0.0, 1.0, 0.0])
    fit = fit_plane(*to_beams(points), 0.01, 0.001, plane.fit(points))
    assert fit is None


@pytest.mark.parametrize("understated", [2.0, 5.0])
def test_covariance_follows_the_residuals_if_they_exceed_the_stated_noise(
    understated: float, rng: np.random.Generator
) -> None:
    exact = beams_at_plane(25)
    far = np.linalg.norm(exact, axis=1, keepdims=True)
    noisy = exact * (1 + rng.normal(0, 0.02, far.shape) / far)
    right, low = (
        fit_plane(*to_beams(noisy), 0.02, 1e-4, PLANE),
        fit_plane(*to_beams(noisy), 0.02 / understated, 1e-4, PLANE),
    )
    assert right is not None
    assert low is not None
    assert np.sqrt(low.covariance[2, 2] / right.covariance[2, 2]) == pytest.approx(1.0, abs=0.1)
    assert low.scale == pytest.approx(understated, rel=0.15)


@pytest.mark.parametrize(("sigma_range", "sigma_angle"), [(0.02, 1e-5), (0.001, 5e-3), (0.01, 3e-3)])
def test_plane_covariance_is_that_of_noise_of_ranges_and_of_directions(
    sigma_range: float, sigma_angle: float, rng: np.random.Generator
) -> None:
    """The squared Mahalanobis distance of 200 planes has its expectation, 3: beams meet them at up to 70°."""
    _, directions = to_beams(beams_at_plane(8))
    count = len(directions)
    axes = np.array([plane.tangent_basis(d) for d in directions])
    total, runs = 0.0, 200
    for _ in range(runs):
        turned = directions + np.einsum("nij,nj->ni", axes, rng.normal(0, sigma_angle, (count, 2)))
        turned /= np.linalg.norm(turned, axis=1)[:, None]
        measured = -PLANE[3] / (turned @ PLANE[:3]) + rng.normal(0, sigma_range, count)
        fit = fit_plane(measured, directions, sigma_range, sigma_angle, PLANE)
        assert fit is not None
        n = fit.parameters[:3]
        error = np.append(plane.tangent_basis(n).T @ PLANE[:3] / (n @ PLANE[:3]), PLANE[3] - fit.parameters[3])
        total += float(error @ np.linalg.solve(fit.covariance, error))
    assert total / runs == pytest.approx(3, rel=0.2)


@pytest.mark.parametrize(("sigma_range", "sigma_angle"), [(0.02, 1e-5), (0.001, 3e-3)])
def test_line_covariance_is_that_of_noise_of_ranges_and_of_angles(
    sigma_range: float, sigma_angle: float, rng: np.random.Generator
) -> None:
    total, runs, ones = 0.0, 200, np.ones(120)
    for _ in range(runs):
        turned = BEAMS + rng.normal(0, sigma_angle, 120)
        ranges = LINE[1] / np.cos(turned - LINE[0]) + rng.normal(0, sigma_range, 120)
        fit = fit_line(BEAMS, ranges, sigma_range * ones, sigma_angle * ones, LINE)
        assert fit is not None
        error = fit.parameters - LINE
        total += float(error @ np.linalg.solve(fit.covariance, error))
    assert total / runs == pytest.approx(2, rel=0.25)

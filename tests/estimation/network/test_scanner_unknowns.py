"""Systematic errors of a network's scanners."""

import numpy as np
import pytest

from calgraph.config import Lidar2dUncertainty
from calgraph.estimation.network.scanner_unknowns import (
    SystematicErrors,
    collect_prior_sigma,
    compute_prior_covariance,
    correct_points,
)


def test_corrected_points_have_true_ranges_and_angles() -> None:
    """A range of 2 m measured with a bias of 1 cm and a scale of 1 %, under an angle 0.5 % too small."""
    stated, measured = 1.0 / 1.005, 2.0 * 1.01 + 0.01
    point = measured * np.array([[np.cos(stated), np.sin(stated)]])
    true = 2.0 * np.array([[np.cos(1.0), np.sin(1.0)]])
    np.testing.assert_allclose(correct_points(point, np.array([0.01, 0.01, 0.005])), true)


def test_the_clock_of_the_root_is_the_reference() -> None:
    one = Lidar2dUncertainty(range_bias=0.01, range_scale=0.02, angle_scale=0.03, clock_drift=0.04, tilt=0.0)
    expected = [[0.01, 0.02, 0.03, 0.0], [0.01, 0.02, 0.03, 0.04]]
    np.testing.assert_array_equal(collect_prior_sigma([one, one], estimate_clocks=True), expected)


def test_tilts_are_part_of_the_range_scale(rng: np.random.Generator) -> None:
    """The root mean square, over tilts of 3°, of the mean excess of ranges over horizontal distances."""
    tilt = rng.normal(0, np.radians(3.0), (20000, 2, 1))
    direction = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    slope = tilt[:, 0] * np.sin(direction) - tilt[:, 1] * np.cos(direction)
    excess = np.sqrt(1 + slope**2) - 1
    sigma = collect_prior_sigma([Lidar2dUncertainty(range_scale=0.0, tilt=3.0)], estimate_clocks=True)
    assert sigma[0, 1] == pytest.approx(np.sqrt(np.mean(excess.mean(axis=1) ** 2)), rel=0.03)


def test_half_of_the_variance_of_beam_errors_is_common() -> None:
    covariance = compute_prior_covariance(np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]]), 0.5)
    np.testing.assert_array_equal(np.diag(covariance), [1, 4, 9, 16, 25, 36, 49, 64])
    np.testing.assert_array_equal(covariance[:4, 4:], np.diag([2.5, 6, 10.5, 0]))


def test_synchronized_clocks_do_not_drift() -> None:
    sigma = collect_prior_sigma([Lidar2dUncertainty()] * 2, estimate_clocks=False)
    np.testing.assert_array_equal(sigma[:, 3], 0.0)


def test_exact_parameters_are_not_summarized() -> None:
    prior = np.array([[0.02, 0.003, 0.0, 0.0]])
    errors = SystematicErrors(np.array([[0.01, -0.001, 0.0, 0.0]]), np.diag(0.25 * prior[0] ** 2), prior)
    bias, scale = errors.summarize(["east"])
    assert (bias.of, bias.quantity, bias.unit, bias.stated, bias.value) == ("east", "range bias", "m", 0.0, 0.01)
    assert (scale.quantity, scale.unit, scale.stated, scale.value) == ("range scale", "", 1.0, 0.999)
    assert (bias.prior, bias.stddev, scale.prior) == (0.02, 0.01, 0.003)
    np.testing.assert_allclose(errors.covariance_of_estimated, np.diag([1e-4, 0.0015**2]), rtol=1e-12)

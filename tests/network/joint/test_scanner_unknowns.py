"""Systematic errors of a network's scanners."""

import numpy as np
import pytest

from calgraph.config import Lidar2dUncertainty
from calgraph.geometry import so3
from calgraph.network.joint.scanner_unknowns import (
    STRETCH_DIAGONAL,
    STRETCH_X,
    SystematicErrors,
    collect_prior_sigma,
    compute_prior_covariance,
    correct_points,
)
from dense_covariances import relate_all


def test_corrected_points_have_true_ranges_and_angles() -> None:
    """A range of 2 m measured with a bias of 1 cm and a scale of 1 %, under an angle 0.5 % too small."""
    stated, measured = 1.0 / 1.005, 2.0 * 1.01 + 0.01
    point = measured * np.array([[np.cos(stated), np.sin(stated)]])
    true = 2.0 * np.array([[np.cos(1.0), np.sin(1.0)]])
    np.testing.assert_allclose(correct_points(point, np.array([0.01, 0.01, 0.005, 0.0, 0.0])), true)


@pytest.mark.parametrize("tilt", [(0.08, 0.0), (0.0, -0.09), (0.06, 0.08), (-0.1, 0.04)])
def test_tilted_scans_are_corrected_to_horizontal_distances(tilt: tuple[float, float]) -> None:
    """Points on a vertical cylinder of 5 m about a scanner whose plane is tilted.

    Beside terms of fourth order, the mean stretch is short by a smoothing of at most 0.1 mm/m.
    """
    azimuth = np.linspace(-3, 3, 25)
    beam = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(25)]) @ so3.exp(np.array([*tilt, 0.0])).T
    ranges = 5.0 / np.hypot(beam[:, 0], beam[:, 1])
    measured = ranges[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    true = ranges[:, None] * beam[:, :2]
    a, b = tilt
    errors = np.array([0.0, 0.0, 0.0, (b**2 - a**2) / 4, -a * b / 2])
    np.testing.assert_allclose(correct_points(measured, errors), true, atol=5e-4 + 10 * np.hypot(a, b) ** 4)
    assert np.abs(measured - true).max() > 0.01


def test_the_clock_of_the_root_is_the_reference() -> None:
    one = Lidar2dUncertainty(range_bias=0.01, range_scale=0.02, angle_scale=0.03, clock_drift=0.04, tilt=0.0)
    expected = [[0.01, 0.02, 0.03, 0.0, 0.0, 0.0], [0.01, 0.02, 0.03, 0.0, 0.0, 0.04]]
    np.testing.assert_array_equal(collect_prior_sigma([one, one]), expected)


def test_priors_of_stretches_are_those_of_normal_tilts(rng: np.random.Generator) -> None:
    """The root mean squares, over tilts of 3°, of harmonics of the excess of ranges over horizontal distances."""
    tilt = rng.normal(0, np.radians(3.0), (20000, 2, 1))
    direction = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    slope = tilt[:, 0] * np.sin(direction) - tilt[:, 1] * np.cos(direction)
    excess = np.sqrt(1 + slope**2) - 1
    sigma = collect_prior_sigma([Lidar2dUncertainty(range_scale=0.0, tilt=3.0)])
    for column, wave in ((STRETCH_X, np.cos(2 * direction)), (STRETCH_DIAGONAL, np.sin(2 * direction))):
        assert sigma[0, column] == pytest.approx(np.sqrt(np.mean((excess @ wave / 6) ** 2)), rel=0.03)


def test_half_of_the_variance_of_ranges_and_angles_is_common() -> None:
    sigma = np.arange(1.0, 13.0).reshape(2, 6)
    covariance = compute_prior_covariance(sigma)
    np.testing.assert_array_equal(np.diag(covariance), sigma.ravel() ** 2)
    np.testing.assert_array_equal(covariance[:6, 6:], np.diag([3.5, 8, 13.5, 0, 0, 0]))


def test_exact_parameters_are_not_summarized() -> None:
    prior = np.array([[0.02, 0.003, 0.0, 0.0, 0.0, 0.0]])
    errors = SystematicErrors(
        np.array([[0.01, -0.001, 0.0, 0.0, 0.0, 0.0]]), relate_all(np.diag(0.25 * prior[0] ** 2), 1), prior
    )
    bias, scale = errors.summarize(["east"])
    assert (bias.of, bias.quantity, bias.unit, bias.stated, bias.value) == ("east", "range bias", "m", 0.0, 0.01)
    assert (scale.quantity, scale.unit, scale.stated, scale.value) == ("range scale", "", 1.0, 0.999)
    assert (bias.prior, bias.stddev, scale.prior) == (0.02, 0.01, 0.003)

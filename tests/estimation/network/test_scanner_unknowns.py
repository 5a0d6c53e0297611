"""Systematic errors of a network's scanners."""

import numpy as np

from calgraph.config import Lidar2dUncertainty
from calgraph.estimation.network.scanner_unknowns import SystematicErrors, collect_prior_sigma, correct_points


def test_corrected_points_have_true_ranges_and_angles() -> None:
    """A range of 2 m measured with a bias of 1 cm and a scale of 1 %, under an angle 0.5 % too small."""
    stated, measured = 1.0 / 1.005, 2.0 * 1.01 + 0.01
    point = measured * np.array([[np.cos(stated), np.sin(stated)]])
    true = 2.0 * np.array([[np.cos(1.0), np.sin(1.0)]])
    np.testing.assert_allclose(correct_points(point, np.array([0.01, 0.01, 0.005])), true)


def test_the_clock_of_the_root_is_the_reference() -> None:
    one = Lidar2dUncertainty(range_bias=0.01, range_scale=0.02, angle_scale=0.03, clock_drift=0.04)
    expected = [[0.01, 0.02, 0.03, 0.0], [0.01, 0.02, 0.03, 0.04]]
    np.testing.assert_array_equal(collect_prior_sigma([one, one], estimate_clocks=True), expected)


def test_synchronized_clocks_do_not_drift() -> None:
    sigma = collect_prior_sigma([Lidar2dUncertainty()] * 2, estimate_clocks=False)
    np.testing.assert_array_equal(sigma[:, 3], 0.0)


def test_exact_parameters_are_not_summarized() -> None:
    prior = np.array([[0.02, 0.003, 0.0, 0.0]])
    errors = SystematicErrors(np.array([[0.01, -0.001, 0.0, 0.0]]), 0.5 * prior, prior)
    bias, scale = errors.summarize(["east"])
    assert (bias.of, bias.quantity, bias.unit, bias.stated, bias.value) == ("east", "range bias", "m", 0.0, 0.01)
    assert (scale.quantity, scale.unit, scale.stated, scale.value) == ("range scale", "", 1.0, 0.999)
    assert (bias.prior, bias.stddev, scale.prior) == (0.02, 0.01, 0.003)

"""Tukey's loss: weights of beams, and the information in them."""

import numpy as np
import pytest

from calgraph.network.joint.scan_equations import TukeyLoss

LOSS = TukeyLoss(2.5)
ALL = np.ones(5, dtype=np.bool_)
RESIDUALS = np.array([-2.0, -0.5, 0.0, 0.5, 2.0])


def test_weights_decrease_with_the_residual() -> None:
    weight = LOSS.compute_weights(RESIDUALS, ALL)
    np.testing.assert_allclose(weight, weight[::-1])
    assert weight[0] < weight[1] < weight[2] < 1


def test_residuals_beyond_the_limit_have_no_weight() -> None:
    np.testing.assert_array_equal(LOSS.compute_weights(np.array([-2.6, 2.6]), ALL[:2]), 0.0)


def test_the_limit_is_lower_in_front_of_the_outline() -> None:
    weight = LOSS.compute_weights(RESIDUALS, ALL, near_side_factor=2.5)
    np.testing.assert_allclose(weight[:3], LOSS.compute_weights(RESIDUALS, ALL)[:3])
    assert (weight[4], 0 < weight[3] < weight[1]) == (0.0, True)


def test_unused_beams_have_no_weight() -> None:
    np.testing.assert_array_equal(LOSS.compute_weights(RESIDUALS, ~ALL), 0.0)


def test_the_sum_of_weights_is_the_information(rng: np.random.Generator) -> None:
    # The robust mean of 100 beams, 4000 times.
    beams, mean = rng.normal(0, 1, (4000, 100)), np.zeros((4000, 1))
    for _ in range(40):
        weight = LOSS.compute_weights(beams - mean, np.ones(beams.shape, dtype=np.bool_))
        mean = np.sum(weight * beams, axis=1, keepdims=True) / np.sum(weight, axis=1, keepdims=True)
    # The standard deviation of the variance of 4000 means is 2.2 %.
    assert np.mean(mean**2) * np.mean(np.sum(weight, axis=1)) == pytest.approx(1, abs=0.08)


@pytest.mark.parametrize("limit", [1.0, 2.5, 5.0])
def test_moments_are_those_of_the_truncated_normal_distribution(limit: float) -> None:
    """Expectation of 1 - 2 (r / c)^2 + 3 (r / c)^4 within the limit, by the trapezoidal rule."""
    r = np.linspace(-limit, limit, 20_001)
    values = (1 - 2 * (r / limit) ** 2 + 3 * (r / limit) ** 4) * np.exp(-(r**2) / 2) / np.sqrt(2 * np.pi)
    expected = np.sum((values[1:] + values[:-1]) / 2 * np.diff(r))
    assert TukeyLoss(limit)._expect([1, 0, -2, 0, 3]) == pytest.approx(expected, rel=1e-6)

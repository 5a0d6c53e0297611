"""How much single beams count."""

import numpy as np
import pytest

from calgraph.estimation.network.scan_equations import compute_tukey_weights

ALL = np.ones(5, dtype=np.bool_)
OFF = np.array([-2.0, -0.5, 0.0, 0.5, 2.0])


def test_beams_count_the_less_the_farther_they_are_off() -> None:
    weight = compute_tukey_weights(OFF, ALL)
    np.testing.assert_allclose(weight, weight[::-1])
    assert weight[0] < weight[1] < weight[2] < 1


def test_beams_beyond_what_noise_explains_count_nothing() -> None:
    np.testing.assert_array_equal(compute_tukey_weights(np.array([-2.6, 2.6]), ALL[:2]), 0.0)


def test_beams_before_the_outline_are_out_of_it_sooner_if_asked_to() -> None:
    weight = compute_tukey_weights(OFF, ALL, near_side_factor=2.5)
    np.testing.assert_allclose(weight[:3], compute_tukey_weights(OFF, ALL)[:3])
    assert (weight[4], 0 < weight[3] < weight[1]) == (0.0, True)


def test_beams_that_are_not_used_count_nothing() -> None:
    np.testing.assert_array_equal(compute_tukey_weights(OFF, ~ALL), 0.0)


def test_weights_of_beams_add_up_to_what_they_tell(rng: np.random.Generator) -> None:
    # The robust mean of 100 beams, 4000 times.
    beams, mean = rng.normal(0, 1, (4000, 100)), np.zeros((4000, 1))
    for _ in range(40):
        weight = compute_tukey_weights(beams - mean, np.ones(beams.shape, dtype=np.bool_))
        mean = np.sum(weight * beams, axis=1, keepdims=True) / np.sum(weight, axis=1, keepdims=True)
    # The variance of 4000 is right to 2.2 %, one standard deviation.
    assert np.mean(mean**2) * np.mean(np.sum(weight, axis=1)) == pytest.approx(1, abs=0.08)

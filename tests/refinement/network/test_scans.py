"""How much single beams count."""

import numpy as np

from calgraph.refinement.network.scans import robust_weights

ALL = np.ones(5, dtype=np.bool_)
OFF = np.array([-2.0, -0.5, 0.0, 0.5, 2.0])


def test_beams_count_the_less_the_farther_they_are_off() -> None:
    weight = robust_weights(OFF, ALL)
    np.testing.assert_allclose(weight, weight[::-1])
    assert (weight[2], weight[0] < weight[1] < weight[2]) == (1.0, True)


def test_beams_beyond_what_noise_explains_count_nothing() -> None:
    np.testing.assert_array_equal(robust_weights(np.array([-2.6, 2.6]), ALL[:2]), 0.0)


def test_beams_before_the_outline_are_out_of_it_sooner_if_asked_to() -> None:
    weight = robust_weights(OFF, ALL, before=2.5)
    np.testing.assert_allclose(weight[:3], robust_weights(OFF, ALL)[:3])
    assert (weight[4], 0 < weight[3] < weight[1]) == (0.0, True)


def test_beams_that_are_not_used_count_nothing() -> None:
    np.testing.assert_array_equal(robust_weights(OFF, ~ALL), 0.0)

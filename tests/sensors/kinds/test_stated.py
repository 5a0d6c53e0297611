"""Noise of scanners as rig.yaml states it."""

import numpy as np

from calgraph.sensors.kinds.stated import RangeNoise

RANGES, DIRECTIONS = np.array([1.0, 4.0, 9.0]), np.tile([0.6, 0.8, 0.0], (3, 1))


def test_ranges_of_scanners_have_the_same_noise_at_all_distances() -> None:
    noise = RangeNoise(range=0.03)
    assert noise.at(RANGES).tolist() == [0.03, 0.03, 0.03]
    assert noise.of_beams(RANGES, DIRECTIONS).tolist() == [0.03, 0.03, 0.03]

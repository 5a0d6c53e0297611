"""Variances that are estimated from the residuals at legs."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.network.joint.leg_solution import LegNoise, estimate_noise
from calgraph.network.joint.legs import LegObservations
from calgraph.network.joint.solver import optimize_network
from leg_scenes import build_network

SIGMA = 0.008
BACKGROUND = np.full(3, 0.01)


def estimate(bias: float) -> LegNoise:
    """The variances for noisy ranges, with biases of both signs between scanners and legs."""
    rng = np.random.default_rng(2)
    problem, state = build_network()
    legs = []
    for leg, signs in zip(problem.bodies, ([1, -1, 1], [-1, 1, 1]), strict=True):
        assert isinstance(leg, LegObservations)
        noisy = [
            replace(scans, ranges=scans.ranges + sign * bias + rng.normal(0, SIGMA, len(scans.ranges)))
            for scans, sign in zip(leg.scans, signs, strict=True)
        ]
        legs.append(replace(leg, scans=tuple(noisy), bias_variance=1e-4))
    problem = replace(problem, bodies=tuple(legs))
    _, equations = optimize_network(problem, state, iterations=10)
    return estimate_noise(equations, BACKGROUND)


def test_range_noise_is_that_of_the_ranges() -> None:
    sigma = estimate(0.0).range_sigma
    assert sigma[:2] == pytest.approx(np.full(2, SIGMA), rel=0.15)
    assert sigma[2] == BACKGROUND[2], "it has fewer than 300 beams on legs"


def test_biases_between_scanners_and_legs_increase_their_variance() -> None:
    assert estimate(0.006).bias_variance > 4 * estimate(0.0).bias_variance


def test_density_of_acceleration_is_within_its_limits() -> None:
    assert 10.0 <= estimate(0.0).acceleration_density <= 100.0

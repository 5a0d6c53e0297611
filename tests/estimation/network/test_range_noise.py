"""How noisy ranges are, told by beams on bodies."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.estimation.network.ellipse_raycast import raycast_ellipses
from calgraph.estimation.network.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.estimation.network.range_noise import estimate_range_noise
from calgraph.estimation.network.scan_equations import compute_tukey_weights
from calgraph.estimation.network.solver import linearize_network, optimize_network
from calgraph.estimation.network.splines import Knots, evaluate_spline
from calgraph.geometry import Array
from network_scenes import OFFSET, SIGMA, T_ROOT, glimpses

STATED = np.array([0.013])


def followed(seconds: float, rng: np.random.Generator) -> tuple[NetworkProblem, NetworkState]:
    """A body that one scanner sees, and the path that fits best: it has few beams to follow."""
    knots = Knots.spanning(-0.5, seconds + 0.5, 0.2)
    t = 0.9 * knots.control_times()
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4), t])
    motion = BodyPath(path, np.array([0.25, 0.15]))
    seen = glimpses(0, knots, motion, np.arange(0.05, seconds, 0.08), rng)
    body = BodyObservations(knots, (seen,), motion.radii, 0.1 * motion.radii, faces_forward=False)
    network = NetworkProblem(1, (body,), (), np.array([SIGMA]), np.array([0.0005, 0.002]) ** 2, 0.0)
    state = NetworkState(T_ROOT[:1], OFFSET[:1], (motion,))
    for _ in range(6):
        network = replace(network, bodies=(weighed(body, state),))
        state, _ = optimize_network(network, state)
    return network, state


def weighed(body: BodyObservations, state: NetworkState) -> BodyObservations:
    """The body with weights of beams about its path."""
    (motion,), (seen,) = state.paths, body.scans
    at = np.repeat(seen.times - OFFSET[seen.scanner], np.diff(seen.first_beam, append=len(seen.ranges)))
    pose, T = evaluate_spline(motion.control, *body.knots.basis_at(at)[:2]), T_ROOT[seen.scanner]
    hits = raycast_ellipses(T[:2, 2], seen.direction @ T[:2, :2].T, pose[:, :2], pose[:, 2], motion.radii)
    weight = compute_tukey_weights((hits.ranges - seen.ranges) / SIGMA, hits.not_grazing)
    return replace(body, scans=(replace(seen, weight=weight),))


def measured(network: NetworkProblem, state: NetworkState) -> Array:
    return estimate_range_noise(network, state, linearize_network(network, state), STATED)


def test_noise_is_measured_though_paths_follow_it(rng: np.random.Generator) -> None:
    # One body's median over 20 s is right to 2.5 %, one standard deviation; uncorrected, it comes to 0.87.
    found = [measured(*followed(20.0, rng))[0] / SIGMA for _ in range(10)]
    assert np.mean(found) == pytest.approx(1, abs=0.03)


def test_scanners_that_see_next_to_nothing_are_as_noisy_as_their_background(rng: np.random.Generator) -> None:
    network, state = followed(2.0, rng)
    np.testing.assert_array_equal(measured(network, state), STATED)


def test_ranges_without_noise_are_not_believed_to_have_none(rng: np.random.Generator) -> None:
    network, state = followed(20.0, rng)
    stated = np.array([3 * SIGMA])
    assert estimate_range_noise(network, state, linearize_network(network, state), stated) == 0.5 * stated

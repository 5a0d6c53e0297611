"""Estimates of the range noise from residuals at bodies."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.range_noise import estimate_range_noise
from calgraph.network.joint.solver import linearize_network, optimize_network
from calgraph.network.joint.splines import Knots, evaluate_spline
from network_scenes import DENSITY, EXACT, LOSS, OFFSET, SETTINGS, SIGMA, T_ROOT, meet_ellipses, simulate_scans

BACKGROUND = np.array([0.013])


def simulate_solution(seconds: float, rng: np.random.Generator) -> tuple[NetworkProblem, NetworkState]:
    """A body in the view of one scanner, and its best path, which has few beams per control point."""
    knots = Knots.spanning(-0.5, seconds + 0.5, 0.2)
    t = 0.9 * knots.control_times()
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4), t])
    body_path = BodyPath(path, np.array([0.25, 0.15]))
    scans = simulate_scans(0, knots, body_path, np.arange(0.05, seconds, 0.08), rng)
    body = EllipseObservations(knots, (scans,), body_path.shape, 0.1 * body_path.shape, faces_forward=False)
    network = NetworkProblem(
        1, (body,), (), np.array([SIGMA]), np.array([0.0005, 0.002]) ** 2, EXACT[:1], 0.0, DENSITY, SETTINGS
    )
    state = NetworkState(T_ROOT[:1], OFFSET[:1], EXACT[:1], (body_path,))
    for _ in range(6):
        network = replace(network, bodies=(update_weights(body, state),))
        state, _ = optimize_network(network, state, iterations=10)
    return network, state


def update_weights(body: BodyObservations, state: NetworkState) -> BodyObservations:
    """The body with robust weights about its path."""
    (body_path,), (scans,) = state.paths, body.scans
    at = np.repeat(scans.times - OFFSET[scans.scanner], np.diff(scans.first_beam, append=len(scans.ranges)))
    pose, T = evaluate_spline(body_path.control, *body.knots.basis_at(at)[:2]), T_ROOT[scans.scanner]
    hits = meet_ellipses(T[:2, 2], scans.direction @ T[:2, :2].T, pose[:, :2], pose[:, 2], body_path.shape)
    weight = LOSS.compute_weights((hits.ranges - scans.ranges) / SIGMA, hits.cos_incidence > 0.35)
    return replace(body, scans=(replace(scans, weight=weight),))


def estimate(network: NetworkProblem, state: NetworkState) -> Array:
    return estimate_range_noise(network, state, linearize_network(network, state), BACKGROUND)


def test_noise_is_unbiased_in_spite_of_leverage(rng: np.random.Generator) -> None:
    # The standard deviation of one estimate from 20 s is 2.5 %; without the correction, the mean is 0.87.
    ratios = [estimate(*simulate_solution(20.0, rng))[0] / SIGMA for _ in range(10)]
    assert np.mean(ratios) == pytest.approx(1, abs=0.03)


def test_with_few_beams_the_noise_is_that_of_the_background(rng: np.random.Generator) -> None:
    network, state = simulate_solution(2.0, rng)
    np.testing.assert_array_equal(estimate(network, state), BACKGROUND)


def test_every_third_beam_gives_the_same_noise_but_for_chance(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, state = simulate_solution(20.0, rng)
    (beams,) = (len(scans.ranges) for scans in network.bodies[0].scans)
    (expected,) = estimate(network, state)
    monkeypatch.setattr("calgraph.network.joint.range_noise._MAX_BEAMS", beams // 2 - 1)
    (noise,) = estimate(network, state)
    # The median of n beams has a relative standard deviation of 1.17 / sqrt(n).
    assert 0 < abs(noise / expected - 1) < 3 * 1.17 / np.sqrt(beams / 3)


def test_noise_is_at_least_half_of_the_background(rng: np.random.Generator) -> None:
    network, state = simulate_solution(20.0, rng)
    background = np.array([3 * SIGMA])
    assert estimate_range_noise(network, state, linearize_network(network, state), background) == 0.5 * background


def test_noise_does_not_depend_on_the_directions_of_the_root_axes(rng: np.random.Generator) -> None:
    """A model error of position, 2 cm along x as along y, with an exact heading: a quarter turn has no effect."""
    network, state = simulate_solution(20.0, rng)
    network = replace(network, model_error_variance=np.array([0.02, 1e-6]) ** 2)
    turn = se2.pose(np.pi / 2, np.zeros(2))
    (path,) = state.paths
    control = np.column_stack([se2.apply(turn, path.control[:, :2]), path.control[:, 2] + np.pi / 2])
    turned = NetworkState(
        turn @ state.T_root_scanner, state.clock_offset, EXACT[:1], (replace(path, control=control),)
    )
    # Without a lower limit by the background.
    background = np.array([0.1 * SIGMA])
    found = [estimate_range_noise(network, s, linearize_network(network, s), background) for s in (state, turned)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)

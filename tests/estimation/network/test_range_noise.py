"""How noisy ranges are, told by beams on bodies."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.estimation.network.ellipse_raycast import cast
from calgraph.estimation.network.range_noise import measured_noise
from calgraph.estimation.network.scan_equations import robust_weights
from calgraph.estimation.network.solver import Body, Motion, Network, State, linearize, solve
from calgraph.estimation.network.splines import Knots, evaluate
from calgraph.geometry import Array
from network_scenes import OFFSET, SIGMA, T_ROOT, glimpses

STATED = np.array([0.013])


def followed(seconds: float, rng: np.random.Generator) -> tuple[Network, State]:
    """A body that one scanner sees, and the path that fits best: it has few beams to follow."""
    knots = Knots.over(-0.5, seconds + 0.5, 0.2)
    t = 0.9 * knots.centres()
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4), t])
    motion = Motion(path, np.array([0.25, 0.15]))
    seen = glimpses(0, knots, motion, np.arange(0.05, seconds, 0.08), rng)
    body = Body(knots, (seen,), motion.radii, 0.1 * motion.radii, faces=False)
    network = Network(1, (body,), (), np.array([SIGMA]), np.array([0.0005, 0.002]) ** 2, 0.0)
    state = State(T_ROOT[:1], OFFSET[:1], (motion,))
    for _ in range(6):
        network = replace(network, bodies=(weighed(body, state),))
        state, _ = solve(network, state)
    return network, state


def weighed(body: Body, state: State) -> Body:
    """The body with weights of beams about its path."""
    (motion,), (seen,) = state.motions, body.glimpses
    at = np.repeat(seen.times - OFFSET[seen.scanner], np.diff(seen.start, append=len(seen.ranges)))
    pose, T = evaluate(motion.control, *body.knots.at(at)[:2]), T_ROOT[seen.scanner]
    hits = cast(T[:2, 2], seen.direction @ T[:2, :2].T, pose[:, :2], pose[:, 2], motion.radii)
    weight = robust_weights((hits.ranges - seen.ranges) / SIGMA, hits.squarely)
    return replace(body, glimpses=(replace(seen, weight=weight),))


def measured(network: Network, state: State) -> Array:
    return measured_noise(network, state, linearize(network, state), STATED)


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
    assert measured_noise(network, state, linearize(network, state), stated) == 0.5 * stated

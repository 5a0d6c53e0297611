"""Estimates of the model error of simulated bodies, of position and of heading."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.model_error import estimate_model_error
from calgraph.network.joint.problem import BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.splines import Knots, evaluate_spline
from network_scenes import DENSITY, EXACT, LOSS, OFFSET, SETTINGS, SIGMA, T_ROOT, meet_ellipses, simulate_scans

SECONDS = 60.0
INITIAL = np.array([0.005, 0.05]) ** 2


def estimate(network: NetworkProblem, state: NetworkState) -> Array:
    """With all bodies in this process."""
    return estimate_model_error(network, state, BodyBatches.place(network.bodies))


def simulate_network(
    position: float, heading: float, rng: np.random.Generator, radii: tuple[float, float] = (0.25, 0.15)
) -> tuple[NetworkProblem, NetworkState]:
    """A body between three scanners, with standard deviations of its displacement per scan, m and rad."""
    knots = Knots.spanning(-0.5, SECONDS + 0.5, 0.2)
    t = 0.9 * knots.control_times()
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4), t])
    body_path = BodyPath(path, np.array(radii))
    times = np.arange(0.05, SECONDS, 0.08)
    scans = tuple(
        displace_scans(simulate_scans(s, knots, body_path, times, rng), knots, body_path, position, heading, rng)
        for s in range(3)
    )
    body = EllipseObservations(knots, scans, body_path.shape, 0.1 * body_path.shape, faces_forward=False)
    network = NetworkProblem(3, (body,), (), np.full(3, SIGMA), INITIAL, EXACT, 0.0, DENSITY, SETTINGS)
    return network, NetworkState(T_ROOT, OFFSET, EXACT, (body_path,))


def displace_scans(
    scans: BodyScans, knots: Knots, body_path: BodyPath, position: float, heading: float, rng: np.random.Generator
) -> BodyScans:
    """The scans of a body that is displaced in each scan, with weights about its path."""
    scan = np.repeat(np.arange(len(scans.times)), np.diff(scans.first_beam, append=len(scans.ranges)))
    pose = evaluate_spline(body_path.control, *knots.basis_at(scans.times - OFFSET[scans.scanner])[:2])[scan]
    displacement = rng.normal(0, [position, position, heading], (len(scans.times), 3))[scan]
    T = T_ROOT[scans.scanner]
    direction = scans.direction @ T[:2, :2].T
    origin, radii = np.broadcast_to(T[:2, 2], direction.shape), np.broadcast_to(body_path.shape, direction.shape)

    def ranges(at: Array) -> Array:
        return meet_ellipses(origin, direction, at[:, :2], at[:, 2], radii).ranges

    hit = scans.ranges + ranges(pose + displacement) - ranges(pose)
    hits = np.isfinite(hit)
    hit = np.where(hits, hit, scans.ranges)
    return replace(scans, ranges=hit, weight=LOSS.compute_weights((ranges(pose) - hit) / SIGMA, hits))


def estimate_rms(position: float, heading: float, rng: np.random.Generator) -> Array:
    """(2,) root mean square of the model errors (m, rad) estimated in six recordings."""
    return np.asarray(
        np.sqrt(np.mean([estimate(*simulate_network(position, heading, rng)) for _ in range(6)], axis=0))
    )


# The relative error is a fifth for one recording, and a tenth for six. Robust weights reduce the estimate, because
# they also reduce the weight of displaced beams.
@pytest.mark.parametrize(("position", "heading"), [(0.005, 0.0), (0.005, 0.06)])
def test_the_position_error_is_estimated(position: float, heading: float, rng: np.random.Generator) -> None:
    assert 0.7 * position < estimate_rms(position, heading, rng)[0] < 1.4 * position


@pytest.mark.parametrize(("position", "heading"), [(0.0, 0.06), (0.003, 0.06)])
def test_the_heading_error_is_estimated(position: float, heading: float, rng: np.random.Generator) -> None:
    assert 0.5 * heading < estimate_rms(position, heading, rng)[1] < 1.4 * heading


def test_exact_bodies_have_a_small_model_error(rng: np.random.Generator) -> None:
    assert np.all(estimate_rms(0.0, 0.0, rng) < 0.6 * np.sqrt(INITIAL))


def test_a_single_scanner_does_not_change_the_model_error(rng: np.random.Generator) -> None:
    network, state = simulate_network(0.0, 0.0, rng)
    alone = replace(network.bodies[0], scans=network.bodies[0].scans[:1])
    np.testing.assert_array_equal(estimate(replace(network, bodies=(alone,)), state), INITIAL)


def test_the_heading_error_of_a_cylinder_is_not_observable(rng: np.random.Generator) -> None:
    assert estimate(*simulate_network(0.0, 0.0, rng, radii=(0.2, 0.2)))[1] == INITIAL[1]

"""The heading search finds to which side people turn."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.ellipses import EllipseObservations, _find_cheapest_sequence, search_headings
from calgraph.network.joint.problem import BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.splines import Knots
from network_scenes import DENSITY, EXACT, OFFSET, SETTINGS, SIGMA, T_ROOT, simulate_scans

RADII = np.array([0.25, 0.15])
KNOTS = Knots.spanning(-0.3, 5.3, 0.2)


def search(network: NetworkProblem, state: NetworkState) -> NetworkState:
    """With all bodies in this process."""
    return search_headings(network, state, BodyBatches.place(network.bodies))


def simulate_turn(side: int) -> Array:
    """(K, 3) control points of a person who turns round on the spot, to the left (1) or right (-1)."""
    t = KNOTS.control_times()
    away = np.maximum(0, np.abs(t - 2.5) - 0.7)
    half = np.clip((t - 1.8) / 1.4, 0, 1)
    return np.column_stack([3.0 - away, np.full_like(t, 2.0), side * np.pi * half])


def scene(
    side: int, rng: np.random.Generator, *, faces_forward: bool = True
) -> tuple[NetworkProblem, NetworkState]:
    """The problem of three scanners, and the true state but for a constant heading."""
    path = BodyPath(simulate_turn(side), RADII)
    scans = tuple(simulate_scans(s, KNOTS, path, np.arange(0.1 + 0.013 * s, 4.9, 0.07), rng) for s in range(3))
    body = EllipseObservations(KNOTS, scans, RADII, 0.3 * RADII, faces_forward)
    network = NetworkProblem(
        3, (body,), (), np.full(3, SIGMA), np.array([0.005, 0.05]) ** 2, EXACT, 0.0, DENSITY, SETTINGS
    )
    constant = np.column_stack([path.control[:, :2], np.zeros(KNOTS.count)])
    return network, NetworkState(T_ROOT, OFFSET, EXACT, (BodyPath(constant, RADII),))


@pytest.mark.parametrize("side", [1, -1])
def test_the_side_of_a_turn_is_found(side: int, rng: np.random.Generator) -> None:
    [path] = search(*scene(side, rng)).paths
    turned = path.control[-4, 2] - path.control[3, 2]
    assert turned == pytest.approx(side * np.pi, abs=0.35)


@pytest.mark.parametrize("side", [1, -1])
def test_headings_are_accurate_throughout_the_turn(side: int, rng: np.random.Generator) -> None:
    [path] = search(*scene(side, rng)).paths
    error = (path.control[3:-3, 2] - simulate_turn(side)[3:-3, 2] + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(error).max() < 0.2


def test_beams_that_end_on_arms_hardly_turn_headings(rng: np.random.Generator) -> None:
    # In a third of the scans, the two outermost beams end 25 cm in front of the torso.
    network, state = scene(1, rng)
    [body] = network.bodies
    scans = []
    for one in body.scans:
        on_arm = np.repeat(rng.random(len(one.times)) < 0.3, 9) & (np.arange(len(one.ranges)) % 9 < 2)
        scans.append(replace(one, ranges=one.ranges - 0.25 * on_arm))
    network = replace(network, bodies=(replace(body, scans=tuple(scans)),))
    [path] = search(network, state).paths
    error = (path.control[3:-3, 2] - simulate_turn(1)[3:-3, 2] + np.pi / 2) % np.pi - np.pi / 2
    assert np.sqrt(np.mean(error**2)) < 0.07


def test_positions_and_radii_stay(rng: np.random.Generator) -> None:
    network, state = scene(1, rng)
    [path] = search(network, state).paths
    np.testing.assert_array_equal(path.control[:, :2], state.paths[0].control[:, :2])


def test_a_cylinder_keeps_its_heading(rng: np.random.Generator) -> None:
    network, state = scene(1, rng, faces_forward=False)
    assert search(network, state).paths[0] is state.paths[0]


def test_without_beams_the_heading_follows_the_path(rng: np.random.Generator) -> None:
    network, state = scene(1, rng)
    [body] = network.bodies
    unseen = tuple(replace(one, weight=np.zeros(len(one.ranges))) for one in body.scans)
    [path] = search(replace(network, bodies=(replace(body, scans=unseen),)), state).paths
    assert np.abs(np.sin(path.control[:, 2])).max() < 0.2


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("gain", "turned"), [(1.9, False), (2.1, True)])
def test_a_turn_costs_half_the_squared_angle_over_the_variance(side: int, gain: float, turned: bool) -> None:
    """A turn of 0.4 rad, of a variance of 0.04 rad²: 2, less than what the second heading saves, or more."""
    grid = np.array([0.0, 0.4 * side])
    found = _find_cheapest_sequence(np.array([[0.0, 10.0], [gain, 0.0]]), grid, 0.04)
    assert found.tolist() == [0, int(turned)]


def test_headings_half_a_turn_apart_are_the_same() -> None:
    """An ellipse looks the same from behind: between 10° and 175° it turns by 15° only."""
    grid = np.radians([10.0, 60.0, 175.0])
    found = _find_cheapest_sequence(np.array([[0.0, 9, 9], [9, 1.0, 1.0]]), grid, 0.1)
    assert found.tolist() == [0, 2]

"""Who turns about: whether to the left or to the right is found from what was seen meanwhile."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.estimation.network.heading_search import search_headings
from calgraph.estimation.network.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.estimation.network.splines import Knots
from calgraph.geometry import Array
from network_scenes import OFFSET, SIGMA, T_ROOT, glimpses

RADII = np.array([0.25, 0.15])
KNOTS = Knots.spanning(-0.3, 5.3, 0.2)


def turning(side: int) -> Array:
    """(K, 3) control points of somebody who comes, turns about on the spot, to the left (1) or right, and goes."""
    t = KNOTS.control_times()
    away = np.maximum(0, np.abs(t - 2.5) - 0.7)
    half = np.clip((t - 1.8) / 1.4, 0, 1)
    return np.column_stack([3.0 - away, np.full_like(t, 2.0), side * np.pi * half])


def scene(side: int, rng: np.random.Generator, *, faces: bool = True) -> tuple[NetworkProblem, NetworkState]:
    """What three scanners see of it, and the state but for the heading, which is held as it was at first."""
    motion = BodyPath(turning(side), RADII)
    seen = tuple(glimpses(s, KNOTS, motion, np.arange(0.1 + 0.013 * s, 4.9, 0.07), rng) for s in range(3))
    body = BodyObservations(KNOTS, seen, RADII, 0.3 * RADII, faces)
    network = NetworkProblem(3, (body,), (), np.full(3, SIGMA), np.array([0.005, 0.05]) ** 2, 0.1)
    held = np.column_stack([motion.control[:, :2], np.zeros(KNOTS.count)])
    return network, NetworkState(T_ROOT, OFFSET, (BodyPath(held, RADII),))


@pytest.mark.parametrize("side", [1, -1])
def test_who_turns_about_is_seen_to_turn_to_the_right_side(side: int, rng: np.random.Generator) -> None:
    [motion] = search_headings(*scene(side, rng)).paths
    turned = motion.control[-4, 2] - motion.control[3, 2]
    assert turned == pytest.approx(side * np.pi, abs=0.35)


@pytest.mark.parametrize("side", [1, -1])
def test_headings_are_right_all_the_while(side: int, rng: np.random.Generator) -> None:
    [motion] = search_headings(*scene(side, rng)).paths
    off = (motion.control[3:-3, 2] - turning(side)[3:-3, 2] + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(off).max() < 0.4


def test_places_and_sizes_stay(rng: np.random.Generator) -> None:
    network, state = scene(1, rng)
    [motion] = search_headings(network, state).paths
    np.testing.assert_array_equal(motion.control[:, :2], state.paths[0].control[:, :2])


def test_a_cylinder_keeps_its_heading(rng: np.random.Generator) -> None:
    network, state = scene(1, rng, faces=False)
    assert search_headings(network, state).paths[0] is state.paths[0]


def test_who_is_seen_by_no_beam_faces_where_the_path_leads(rng: np.random.Generator) -> None:
    network, state = scene(1, rng)
    [body] = network.bodies
    unseen = tuple(replace(one, weight=np.zeros(len(one.ranges))) for one in body.scans)
    [motion] = search_headings(replace(network, bodies=(replace(body, scans=unseen),)), state).paths
    assert np.abs(np.sin(motion.control[:, 2])).max() < 0.2

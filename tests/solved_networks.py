"""Joint solutions of three scanners and two people, from scans that a test may change."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.body_equations import update_weights
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.solver import NetworkEquations, optimize_network
from calgraph.network.joint.splines import Knots
from network_scenes import DENSITY, EXACT, OFFSET, SETTINGS, SIGMA, T_ROOT, simulate_scans

SECONDS = 24.0
MIDDLE = SECONDS / 2
Change = Callable[[int, BodyScans], BodyScans]
"""From the index of a body and one scanner's scans of it to what the test has instead."""


def no_change(_body: int, scans: BodyScans) -> BodyScans:
    """The scans as they are."""
    return scans


def replace_bodies(solved: NetworkEquations, bodies: Sequence[BodyObservations]) -> NetworkEquations:
    """The solution as if it was that of other measurements."""
    problem = replace(solved.network, bodies=tuple(bodies))
    return replace(solved, network=problem, batches=BodyBatches.place(problem.bodies))


def solve_two_walks(rng: np.random.Generator, change: Change = no_change) -> NetworkEquations:
    """The solution of two people's walks, with robust weights."""
    paths = [_simulate_path(phase) for phase in (0.0, 2.0)]
    bodies = []
    for index, (knots, path) in enumerate(paths):
        times = np.arange(0.05, SECONDS, 0.08)
        scans = tuple(change(index, simulate_scans(k, knots, path, times + 0.02 * k, rng)) for k in range(3))
        bodies.append(EllipseObservations(knots, scans, path.shape, 0.3 * path.shape, faces_forward=True))
    network = NetworkProblem(
        3, tuple(bodies), (), np.full(3, SIGMA), np.array([0.0005, 0.002]) ** 2, EXACT, MIDDLE, DENSITY, SETTINGS
    )
    state = NetworkState(T_ROOT, OFFSET, EXACT, tuple(path for _, path in paths))
    for _ in range(6):
        network, batches = update_weights(network, state, BodyBatches.place(network.bodies))
        state, equations = optimize_network(network, state, iterations=6, batches=batches)
    return equations


def _simulate_path(phase: float) -> tuple[Knots, BodyPath]:
    knots = Knots.spanning(-0.5, SECONDS + 0.5, 0.2)
    t = 0.9 * knots.control_times() + phase
    position = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4)])
    heading = np.unwrap(np.arctan2(1.35 * np.cos(1.5 * t + 0.4), 1.4 * np.cos(t)))
    return knots, BodyPath(np.column_stack([position, heading]), np.array([0.25, 0.15]))

"""The joint solution of long rows of scanners, whose bend only the sum of many small angles determines."""

import numpy as np
import pytest

from calgraph.config import People
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.estimate import NetworkSolution, solve_network
from calgraph.network.joint.problem import BodyPath
from calgraph.network.joint.splines import Knots
from calgraph.network.tracking.track import ScannerTracks
from network_scenes import DENSITY, SETTINGS, SIGMA, build_track, simulate_scans

pytestmark = pytest.mark.slow

COUNT, SPACING, REACH, SPEED = 30, 3.0, 5.0, 1.2
DURATION = COUNT * SPACING / SPEED
T_TRUE = se2.pose(np.zeros(COUNT), np.column_stack([SPACING * np.arange(COUNT), np.zeros(COUNT)]))
NO_OFFSET = np.zeros(COUNT)


def walk_along(back: bool) -> tuple[Knots, BodyPath]:
    """A person who passes all scanners in a wavy line."""
    knots = Knots.spanning(0.0, DURATION, 0.2)
    t = knots.control_times()
    x = SPEED * (DURATION - t if back else t) - SPACING / 2
    y = (1.6 if back else 2.2) + 0.4 * np.sin(0.8 * t)
    heading = np.arctan2(np.gradient(y, t), np.gradient(x, t))
    return knots, BodyPath(np.column_stack([x, y, np.unwrap(heading)]), np.array([0.25, 0.15]))


@pytest.fixture(scope="module")
def solution() -> NetworkSolution:
    rng = np.random.default_rng(0)
    walks = [walk_along(back) for back in (False, True)]
    tracked = []
    for s in range(COUNT):
        tracks = []
        for knots, path in walks:
            times = np.arange(0.5 + 0.01 * (s % 7), DURATION - 0.5, 0.1)
            x = np.interp(times, knots.control_times(), path.control[:, 0])
            seen = times[np.abs(x - SPACING * s) < REACH]
            scans = simulate_scans(s, knots, path, seen, rng, T_TRUE, NO_OFFSET)
            tracks.append(build_track(scans, knots, path, rng, T_TRUE, NO_OFFSET))
        tracked.append(ScannerTracks(tuple(tracks), np.zeros((0, 2)), SIGMA))
    edges = np.column_stack([np.arange(COUNT - 1), np.arange(1, COUNT)])
    T = se2.inverse(T_TRUE[edges[:, 0]]) @ T_TRUE[edges[:, 1]]
    graph = PoseGraph(COUNT, edges, T, np.tile(np.diag([1e4, 1e4, 1e5]), (len(edges), 1, 1)))
    # Averaged poses: each is off by 1 cm and a fifth of a degree relative to the one before.
    start = accumulate(T, rng.normal(0, [0.01, 0.01, 0.0035], (COUNT - 1, 3)))
    return solve_network(
        People(kind="people", axes=(0.25, 0.15)),
        tracked,
        PoseGraphSolution(start, np.ones(COUNT - 1, dtype=np.bool_)),
        graph,
        settings=SETTINGS,
        acceleration_density=DENSITY,
    )


def accumulate(T: Array, errors: Array) -> Array:
    """(S, 3, 3) poses of a row with these steps (S - 1, 3, 3) and their errors (S - 1, 3)."""
    poses = [np.eye(3)]
    for step in se2.retract(T, errors):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def test_poses_of_a_long_row_are_at_the_minimum(solution: NetworkSolution) -> None:
    assert solution.solved is not None
    (step, _), _ = solution.solved.solve(0.0)
    poses = step.reshape(COUNT, -1)[1:, :3]
    sigma = np.sqrt(np.diagonal(solution.pose_covariance)).reshape(-1, 3)[1:]
    assert np.abs(poses / sigma).max() < 0.2


def test_the_bend_of_a_long_row_is_within_its_uncertainty(solution: NetworkSolution) -> None:
    error = se2.difference(solution.T_root_scanner, T_TRUE)[-1]
    assert np.abs(error / np.sqrt(np.diagonal(solution.pose_covariance)[-3:])).max() < 3

"""Displaced nodes of trees in SE(3): which, how far, and what cannot be distinguished."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.verdict.displaced_nodes import estimate_displacements, find_displaced_nodes

MAX_SETS = 3000
STEP = np.array([0.006, -0.008, 0.0, 0.0, 0.0, 0.01])


def random_tree(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Poses (N, 4, 4) of which the first is the root's, and a covariance (6N, 6N) of millimetres."""
    T = se3.pose(so3.exp(rng.uniform(-2, 2, (count, 3))), rng.uniform(-1, 1, (count, 3)))
    T[0] = np.eye(4)
    mixed = rng.normal(0, 1e-3, (6 * count, 6 * count)) / 4
    covariance = mixed @ mixed.T + 1e-7 * np.eye(6 * count)
    covariance[:6] = covariance[:, :6] = 0
    return T, covariance


def measure_difference(T: Array, covariance: Array, rng: np.random.Generator, moved: dict[int, Array]) -> Array:
    """Estimated difference (N, 6) after some nodes have moved along the axes of the root before it moved."""
    after = T.copy()
    for node, step in moved.items():
        after[node] = se3.retract(T[node], step)
    error = rng.multivariate_normal(np.zeros(len(covariance)), covariance).reshape(-1, 6)
    return np.asarray(se3.difference(se3.retract(se3.inverse(after[0]) @ after, error), T))


@pytest.mark.parametrize("node", range(4))
def test_the_moved_node_is_named_even_if_it_is_the_root(node: int) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T, covariance = random_tree(rng, 4)
        difference = measure_difference(T, covariance, rng, {node: STEP})
        assert find_displaced_nodes(T, difference, covariance, 1e-4, MAX_SETS) == [(node,)]


def test_false_alarms_are_as_frequent_as_stated() -> None:
    """400 trees at 5 %: 20 false alarms, with three standard deviations of 13."""
    alarms = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        T, covariance = random_tree(rng, 3)
        alarms += find_displaced_nodes(
            T, measure_difference(T, covariance, rng, {}), covariance, 0.05, MAX_SETS
        ) != [()]
    assert abs(alarms - 20) < 14


@pytest.mark.parametrize("node", [0, 2])
def test_displacements_scatter_as_their_covariance(node: int) -> None:
    """60 displacements: their mean squared Mahalanobis distance is 6, with three standard deviations of 1.35."""
    squared = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T, covariance = random_tree(rng, 3)
        difference = measure_difference(T, covariance, rng, {node: STEP})
        (step,), (spread,) = estimate_displacements(T, difference, covariance, [node])
        squared.append(float((step - STEP) @ np.linalg.solve(spread, step - STEP)))
    assert np.mean(squared) == pytest.approx(6.0, abs=1.5)


def test_of_two_nodes_either_may_have_moved() -> None:
    rng = np.random.default_rng(0)
    T, covariance = random_tree(rng, 2)
    difference = measure_difference(T, covariance, rng, {1: STEP})
    assert find_displaced_nodes(T, difference, covariance, 1e-4, MAX_SETS) == [(1,), (0,)]


def test_nodes_with_nearly_the_same_likelihood_are_all_named() -> None:
    """Without the pose of the third node, a step of the second one looks like one of the root."""
    rng = np.random.default_rng(3)
    T, covariance = random_tree(rng, 3)
    covariance[12:, 12:] += 1e4 * np.eye(6)
    covariance[6:12, 12:] = covariance[12:, 6:12] = 0
    difference = measure_difference(T, covariance, rng, {1: STEP})
    assert set(find_displaced_nodes(T, difference, covariance, 1e-4, MAX_SETS, 1e3)) == {(0,), (1,)}

"""The first tree of the consensus."""

import itertools

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.graph import tree_consensus
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.random_trees import compute_tree_poses
from calgraph.graph.spanning_tree import find_minimum_tree
from calgraph.graph.tree_consensus import _draw_edge_costs, average_poses
from pose_graphs import complete, measured, true_poses


@pytest.mark.parametrize("seed", range(5))
def test_the_first_tree_has_the_least_total_cost(seed: int) -> None:
    """Against all spanning trees of five nodes, some of whose pairs have alternatives in either direction."""
    rng = np.random.default_rng(seed)
    edges = [*complete(5)[:8], (1, 0), (0, 1), (3, 1)]
    graph, costs = measured(true_poses(5, 2, rng), edges, rng), rng.uniform(0.1, 1.0, len(edges))
    trees = [
        list(chosen)
        for chosen in itertools.combinations(range(len(edges)), 4)
        if graph.select_edges(np.isin(np.arange(len(edges)), chosen)).find_reachable().all()
    ]
    cheapest = min(trees, key=lambda chosen: costs[chosen].sum())
    assert np.flatnonzero(find_minimum_tree(graph, costs)).tolist() == cheapest


def test_the_first_tree_excludes_the_edge_of_least_weight(rng: np.random.Generator) -> None:
    graph = measured(true_poses(3, 2, rng), complete(3), rng)
    costs = _draw_edge_costs(graph, np.array([1.0, 0.1, 1.0]), 3, rng)
    assert (costs[0] > 1e8).tolist() == [False, True, False]


@pytest.mark.parametrize(("tree_edges", "expected"), [(1, 2), (100, 6), (10_000, 50)])
def test_the_number_of_trees_follows_from_their_edges_within_limits(
    tree_edges: int, expected: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trees of a graph of 15 edges, at least 2 and at most 50."""
    monkeypatch.setattr("calgraph.graph.tree_consensus._TREE_EDGES", tree_edges)
    monkeypatch.setattr("calgraph.graph.tree_consensus._MIN_TREES", 2)
    monkeypatch.setattr("calgraph.graph.tree_consensus._MAX_TREES", 50)
    counts: list[int] = []

    def record_count(graph: PoseGraph, costs: Array) -> Array:
        counts.append(len(costs))
        return compute_tree_poses(graph, costs)

    monkeypatch.setattr(tree_consensus, "compute_tree_poses", record_count)
    average_poses(measured(true_poses(6, 2, rng), complete(6), rng), rng)
    assert counts == [expected]


def test_the_weight_of_an_edge_decides_in_the_first_trees_only(rng: np.random.Generator) -> None:
    """Edges from node 0 have a hundredth of the weight: cheap in no first tree, as cheap as others in the last."""
    edges = complete(30)
    graph = measured(true_poses(30, 2, rng), edges, rng)
    light = np.array([i == 0 for i, _ in edges])
    costs = _draw_edge_costs(graph, np.where(light, 0.01, 1.0), 40, rng)
    ratio = np.median(costs[:, light], axis=1) / np.median(costs[:, ~light], axis=1)
    assert (ratio[:10] > 10).all()
    assert 0.4 < ratio[-1] < 2.5

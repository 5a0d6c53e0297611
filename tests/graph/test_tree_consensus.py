"""The first tree of the consensus."""

import itertools

import numpy as np
import pytest

from calgraph.graph.tree_consensus import _cheapest_tree
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
    assert np.flatnonzero(_cheapest_tree(graph, costs)).tolist() == cheapest

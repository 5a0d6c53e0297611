"""Poses along shortest-path trees, and moves of single nodes to poses that more edges support."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from calgraph.geometry import Array, se_n
from calgraph.graph import random_trees
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.random_trees import compute_tree_poses, improve_by_votes
from pose_graphs import complete, measured, random_poses, ring, true_poses, with_wrong

BOTH = pytest.mark.parametrize("n", [2, 3])


@BOTH
@pytest.mark.parametrize("root", [0, 4])
def test_poses_follow_the_shortest_paths(n: int, root: int, rng: np.random.Generator) -> None:
    edges = np.array(complete(9))[rng.permutation(36)[:24]]
    g = measured(true_poses(9, n, rng), np.concatenate([edges, np.array(ring(9))]), rng, noise=5.0)
    graph = PoseGraph(g.count, g.edges, g.T_i_j, g.information, root)
    _, first_of_pair = np.unique(graph.pair_of_edge, return_index=True)  # without alternatives
    graph = graph.select_edges(np.isin(np.arange(len(graph.edges)), first_of_pair))
    costs = rng.uniform(0.1, 1.0, (5, len(graph.edges)))
    found = compute_tree_poses(graph, costs)
    for T, cost in zip(found, costs, strict=True):
        matrix = coo_array((cost, graph.edges.T), shape=(9, 9)).tocsr()
        _, previous = dijkstra(matrix, directed=False, indices=root, return_predecessors=True)
        np.testing.assert_allclose(T[root], np.eye(n + 1))
        for node in set(range(9)) - {root}:
            before = int(previous[node])
            forth = np.flatnonzero((graph.edges == [before, node]).all(axis=1))
            back = np.flatnonzero((graph.edges == [node, before]).all(axis=1))
            step = graph.T_i_j[forth[0]] if len(forth) else se_n.inverse(graph.T_i_j[back[0]])
            np.testing.assert_allclose(T[node], T[before] @ step, atol=1e-9)


@BOTH
def test_misplaced_nodes_move_to_where_most_of_their_edges_agree(n: int, rng: np.random.Generator) -> None:
    """Three of ten nodes are misplaced, and a fifth of all edges wrong; the root never moves."""
    T = true_poses(10, n, rng)
    graph = with_wrong(measured(T, complete(10), rng), rng.permutation(45)[:9].tolist(), rng)
    start = T.copy()
    start[[2, 5, 9]] = random_poses(3, n, rng)
    found = improve_by_votes(graph, np.ones(45), start, 16.0, rng)
    np.testing.assert_allclose(found, T, atol=1e-9)


def test_nodes_move_for_more_than_half_a_vote_only(rng: np.random.Generator) -> None:
    """Node 2 agrees with none of its edges of the weight given; its right pose gains their votes."""
    T = true_poses(3, 2, rng)
    graph = measured(T, [(0, 1), (0, 2), (1, 2)], rng)
    start = T.copy()
    start[2] = random_poses(1, 2, rng)[0]
    for weight, moved in ((0.24, False), (0.26, True)):
        weights = np.array([5.0, weight, weight])
        found = improve_by_votes(graph, weights, start, 16.0, rng)
        np.testing.assert_allclose(found[2], T[2] if moved else start[2], atol=1e-9)


def test_votes_decrease_with_the_squared_distance_up_to_the_gate(rng: np.random.Generator) -> None:
    """Exact edges predict another pose; the current one has nearly all of their votes, or nearly none."""
    T = true_poses(4, 2, rng)
    g = measured(T, [(0, 3), (1, 3), (2, 3), (0, 1), (0, 2)], rng)
    sigma = 1 / np.sqrt(g.information[0, 0, 0])
    for share, moved in ((0.05, False), (0.95, True)):
        start = T.copy()
        start[3, 0, 2] += np.sqrt(share * 16.0) * sigma
        found = improve_by_votes(g, np.array([0.5, 0.5, 0.01, 5, 5]), start, 16.0, rng)
        np.testing.assert_allclose(found[3], T[3] if moved else start[3], atol=1e-9)


def build_star(leaves: int, rng: np.random.Generator) -> tuple[Array, PoseGraph]:
    """True poses, and exact edges from the root to all other nodes."""
    T = true_poses(leaves + 1, 2, rng)
    return T, measured(T, [(0, k) for k in range(1, leaves + 1)], rng)


def test_half_of_the_nodes_that_gain_votes_move_in_a_sweep(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of 400 nodes are misplaced: 200 move, with a standard deviation of 10."""
    monkeypatch.setattr(random_trees, "_MAX_SWEEPS", 1)
    T, graph = build_star(400, rng)
    start = np.concatenate([T[:1], random_poses(400, 2, rng)])
    found = improve_by_votes(graph, np.ones(400), start, 16.0, rng)
    moved = np.abs(found - start).max(axis=(1, 2)) > 0
    assert moved.sum() == pytest.approx(200, abs=40)


def test_the_node_of_largest_gain_moves_in_every_sweep(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(random_trees, "_MAX_SWEEPS", 1)
    T, graph = build_star(3, rng)
    for _ in range(20):
        start = np.concatenate([T[:1], random_poses(3, 2, rng)])
        found = improve_by_votes(graph, np.array([1.0, 2.0, 1.0]), start, 16.0, rng)
        np.testing.assert_allclose(found[2], T[2], atol=1e-9)


@pytest.mark.parametrize(("share", "moved"), [(0.4, True), (0.6, False)])
def test_nodes_with_the_majority_of_their_edges_stay(share: float, moved: bool, rng: np.random.Generator) -> None:
    """Node 3 is where one edge of the weight share puts it; the two others agree with another pose."""
    T = true_poses(4, 2, rng)
    graph = measured(T, [(0, 1), (0, 2), (0, 3), (1, 3), (2, 3)], rng)
    start = T.copy()
    start[3] = random_poses(1, 2, rng)[0]
    graph.T_i_j[2] = start[3]
    weights = np.array([50.0, 50.0, 10 * share, 5 * (1 - share), 5 * (1 - share)])
    found = improve_by_votes(graph, weights, start, 16.0, rng)
    np.testing.assert_allclose(found[3], T[3] if moved else start[3], atol=1e-9)

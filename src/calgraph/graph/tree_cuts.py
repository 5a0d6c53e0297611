"""The minimum spanning tree of a graph, and its fundamental cuts: the two parts that each of its edges joins."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

from calgraph.geometry import Array
from calgraph.graph.pose_graph import PoseGraph
from calgraph.solver.ransac import select_best_of_groups


def find_minimum_tree(graph: PoseGraph, costs: Array) -> NDArray[np.bool_]:
    """(E,) the edges of the spanning tree of least total cost, from positive costs (E,)."""
    # The cheapest alternative of each pair; SciPy would sum them.
    best = select_best_of_groups(costs / costs.max(initial=0.0), graph.pair_of_edge)
    i, j = graph.edges[best].T
    tree = minimum_spanning_tree(coo_array((costs[best], (i, j)), shape=(graph.count, graph.count))).tocoo()
    chosen = np.isin(i * graph.count + j, tree.row * graph.count + tree.col)
    in_tree = np.zeros(len(costs), dtype=np.bool_)
    in_tree[np.flatnonzero(best)[chosen]] = True
    return in_tree


def fundamental_cuts(graph: PoseGraph, evidence: Array) -> list[tuple[int, NDArray[np.bool_]]]:
    """The edges of the tree of most evidence, and the nodes (N,) that each separates from the root.

    Args:
        graph: connected by edges with evidence.
        evidence: (E,) weight of each edge, not negative.
    """
    used = np.flatnonzero(evidence)
    graph = graph.select_edges(used)
    tree = np.flatnonzero(find_minimum_tree(graph, 1 / evidence[used]))
    i, j = graph.edges[tree].T
    adjacency = coo_array((np.ones(len(tree)), (i, j)), shape=(graph.count, graph.count))
    order, parent = depth_first_order(adjacency, graph.root, directed=False)
    # Of nodes in depth-first order, a subtree is a range: its first node, and as many as it has.
    size = np.ones(graph.count, dtype=np.intp)
    for node in order[:0:-1].tolist():
        size[parent[node]] += size[node]
    position = np.full(graph.count, -1)
    position[order] = np.arange(len(order))
    beyond = np.where(parent[j] == i, j, i)
    begin, end = position[beyond], position[beyond] + size[beyond]
    return [
        (int(used[edge]), (position < 0) | (position >= first) & (position < last))
        for edge, first, last in zip(tree.tolist(), begin.tolist(), end.tolist(), strict=True)
    ]

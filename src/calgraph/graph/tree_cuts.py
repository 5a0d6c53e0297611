"""Fundamental cuts of a graph: the two parts into which each edge of its maximum spanning tree divides it."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from calgraph.geometry import Array
from calgraph.graph.pose_graph import PoseGraph


def fundamental_cuts(graph: PoseGraph, evidence: Array) -> list[tuple[int, NDArray[np.bool_]]]:
    """The edges of the maximum spanning tree, and the nodes (N,) that each separates from the root.

    Args:
        graph: connected by edges with evidence.
        evidence: (E,) weight of each edge; of several edges of a pair at most one may be above zero.
    """
    used = np.flatnonzero(evidence)
    costs = coo_array((1 / evidence[used], graph.edges[used].T), shape=(graph.count, graph.count))
    tree = minimum_spanning_tree(costs).tocoo()
    edge_of = {(int(a), int(b)): int(edge) for (a, b), edge in zip(graph.edges[used], used, strict=True)}
    cuts = []
    for k, ends in enumerate(zip(map(int, tree.row), map(int, tree.col), strict=True)):
        others = np.arange(tree.nnz) != k
        rest = coo_array((tree.data[others], (tree.row[others], tree.col[others])), shape=tree.shape)
        part = connected_components(rest, directed=False)[1]
        far = ends[0] if part[ends[0]] != part[graph.root] else ends[1]
        cuts.append((edge_of[ends], part == part[far]))
    return cuts

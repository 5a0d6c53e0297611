"""The minimum spanning tree of a rig's pairs: which sensors are connected to the root, and start poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

from calgraph.config.settings import BoardPairSettings
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.pose_graph import PoseGraph
from calgraph.solver.ransac import select_best_of_groups


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """A tree of sensors with the start pose of each."""

    root: str
    parents: Mapping[str, str]
    """Parent of every connected sensor but the root, parents before their children."""
    T_root_sensor: Mapping[str, Array]
    """Start pose (4, 4) of every connected sensor, the root included."""

    def has_edge(self, a: str, b: str) -> bool:
        """Whether one of the two sensors is the parent of the other."""
        return self.parents.get(a) == b or self.parents.get(b) == a


def find_spanning_tree(
    root: str, estimates: Sequence[PairwiseEstimate], max_stddev: float = BoardPairSettings().max_stddev
) -> SpanningTree:
    """Grows the minimum spanning tree from the root (Prim), by summed squared error (MSG-Cal, V).

    Pairs with an unobserved direction are used only where no other pair reaches a sensor.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; at most one for each pair.
        max_stddev: a pair does not observe directions of a larger standard deviation, m and rad.

    Returns:
        The tree of all sensors that are connected to the root.
    """
    return grow_tree(SpanningTree(root, {}, {root: np.eye(4)}), estimates, max_stddev)


def grow_tree(
    tree: SpanningTree, estimates: Sequence[PairwiseEstimate], max_stddev: float = BoardPairSettings().max_stddev
) -> SpanningTree:
    """The tree with all sensors that estimates connect to it, extended as :func:`find_spanning_tree` does."""
    poses, parents = dict(tree.T_root_sensor), dict(tree.parents)
    directed = [*estimates, *(e.inverse() for e in estimates)]
    while True:
        leaving = [e for e in directed if e.sensor_a in poses and e.sensor_b not in poses]
        if not leaving:
            return SpanningTree(tree.root, parents, poses)
        best = min(leaving, key=lambda e: (unobservable_stddev(e, max_stddev), e.squared_error))
        parents[best.sensor_b] = best.sensor_a
        poses[best.sensor_b] = poses[best.sensor_a] @ best.T_a_b


def unobservable_stddev(estimate: PairwiseEstimate, max_stddev: float) -> float:
    """Standard deviation (m or rad) along the weakest direction if that is unobserved; 0 otherwise."""
    # Zero information would have no finite weight.
    weakest = max(float(np.linalg.eigvalsh(estimate.information)[0]), 1e-12)
    return 0.0 if weakest >= max_stddev**-2 else weakest**-0.5


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

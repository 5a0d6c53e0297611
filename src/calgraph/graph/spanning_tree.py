"""The minimum spanning tree of a rig's pairs: which sensors are connected to the root, and start poses."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

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
    ranked = sorted(estimates, key=lambda e: (unobservable_stddev(e, max_stddev), e.squared_error))
    names = list(dict.fromkeys([*poses, *(end for e in ranked for end in (e.sensor_a, e.sensor_b))]))
    ends = [(names.index(e.sensor_a), names.index(e.sensor_b)) for e in ranked]
    for step in walk_tree(len(names), ends, range(len(poses))):
        estimate, parent, child = ranked[step.edge], names[step.parent], names[step.child]
        parents[child] = parent
        directed = estimate if estimate.sensor_a == parent else estimate.inverse()
        poses[child] = poses[parent] @ directed.T_a_b
    return SpanningTree(tree.root, parents, poses)


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
    ranked = np.argsort(-evidence, kind="stable")
    ranked = ranked[evidence[ranked] > 0]
    tree = walk_tree(graph.count, graph.edges[ranked].tolist(), [graph.root])
    reached = np.isin(np.arange(graph.count), [graph.root, *(step.child for step in tree)])
    parts = list_parts(graph.count, tree) | ~reached
    cuts = [(int(ranked[step.edge]), part) for step, part in zip(tree, parts, strict=True)]
    return sorted(cuts, key=lambda cut: cut[0])


class TreeStep(NamedTuple):
    """How a tree reaches a node."""

    edge: int
    parent: int
    child: int


def walk_tree(count: int, ranked: Sequence[tuple[int, int]], start: Iterable[int]) -> list[TreeStep]:
    """Grows the spanning tree that prefers the first of ranked edges (Prim), parents before their children.

    Args:
        count: of the nodes.
        ranked: both ends of each edge.
        start: nodes that the tree starts with.
    """
    of_node: list[list[int]] = [[] for _ in range(count)]
    for rank, ends in enumerate(ranked):
        for node in ends:
            of_node[node].append(rank)
    reached, tree = set(start), list[TreeStep]()
    leaving = sorted(rank for node in reached for rank in of_node[node])
    while leaving:
        edge = heappop(leaving)
        parent, child = ranked[edge] if ranked[edge][0] in reached else reversed(ranked[edge])
        if child in reached:
            continue
        reached.add(child)
        tree.append(TreeStep(edge, parent, child))
        for rank in of_node[child]:
            heappush(leaving, rank)
    return tree


def list_parts(count: int, tree: Sequence[TreeStep]) -> NDArray[np.bool_]:
    """(T, N) which of the nodes each step of a tree leads to: its child, and what is beyond."""
    parts = np.zeros((len(tree), count), dtype=np.bool_)
    row = {step.child: k for k, step in enumerate(tree)}
    for k, step in reversed(list(enumerate(tree))):
        parts[k, step.child] = True
        if step.parent in row:
            parts[row[step.parent]] |= parts[k]
    return parts

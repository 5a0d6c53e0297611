"""Consensus over spanning trees: the node poses that most edges agree with, for any errors of the others.

A tree of inliers gives all poses, and all inliers agree with them. Trees are drawn at random, edges of consistent
cycles more often. The best trees by truncated residuals of whole transforms are refined.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.graph.cycles import OUTLIER_PROBABILITY, edge_support, find_cycle_basis, find_cycles_through_edges
from calgraph.graph.graph_optimization import optimize_poses, optimize_poses_robustly
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution, chi_squared
from calgraph.graph.random_trees import compute_tree_poses, improve_by_votes
from calgraph.graph.spanning_tree import find_minimum_tree

# Cost factor that excludes an edge from a tree wherever there is another path.
_EXCLUDED = 1e9
# Most rounds of least squares over the inliers; they usually stay the same after two.
_MAX_ROUNDS = 5


# Minimum weight of an edge, which keeps the graph connected: a thousand of them weigh as much as a right edge.
_MIN_EDGE_WEIGHT = 1e-3
# Random trees are drawn until they have this number of edges in total, within the limits below; it bounds the
# time.
_TREE_EDGES = 100_000
# Minimum number of random trees, for graphs of more than 12,500 edges.
_MIN_TREES = 8
# Maximum number of random trees: with half of the edges wrong, 1 in 130 trees of seven edges has none of them, if
# drawn without regard to cycles.
_MAX_TREES = 600
# The best trees are refined until they have this number of edges in total, within the limits below.
_REFINED_EDGES = 5_000
# Minimum number of refined trees, for graphs of more than 5000 edges.
_MIN_REFINED_TREES = 1
# Maximum number of refined trees: the score after refinement decides among those before it.
_MAX_REFINED_TREES = 6
# Factor of the gate of squared distances before refinement: noise of nine edges in a row along a tree.
_TREE_GATE_FACTOR = 9.0


def average_poses(graph: PoseGraph, rng: np.random.Generator, weights: Array | None = None) -> PoseGraphSolution:
    """The node poses that most pairs agree with, without start values, optimized over the inliers.

    Args:
        graph: connected; several edges of a pair are alternatives, of which the best is scored.
        rng: source of the trees.
        weights: (E,) of the edges, 0..1; uniform if None.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    graph.require_connected()
    if graph.count == 1:
        return PoseGraphSolution(np.eye(graph.dimension + 1)[None], np.zeros(len(graph.edges), dtype=np.bool_))
    weights = np.ones(len(graph.edges)) if weights is None else np.maximum(weights, _MIN_EDGE_WEIGHT)
    gate = float(chdtri(graph.information.shape[-1], OUTLIER_PROBABILITY))
    edges = max(len(graph.edges), 1)
    count = int(np.clip(_TREE_EDGES // edges, _MIN_TREES, _MAX_TREES))
    to_refine = int(np.clip(_REFINED_EDGES // edges, _MIN_REFINED_TREES, _MAX_REFINED_TREES))
    starts = compute_tree_poses(graph, _draw_edge_costs(graph, weights, count, rng))
    scores, inliers_of_tree = _score(graph, weights, starts, gate * _TREE_GATE_FACTOR)
    best: PoseGraphSolution | None = None
    best_score, refined_inliers = np.inf, set[bytes]()
    for k in np.argsort(scores, kind="stable"):
        if inliers_of_tree[k].tobytes() in refined_inliers:
            continue
        refined_inliers.add(inliers_of_tree[k].tobytes())
        T = _refine_tree(graph, weights, starts[k], gate, rng)
        (score,), (inliers,) = _score(graph, weights, T[None], gate)
        if best is None or score < best_score:
            best, best_score = PoseGraphSolution(T, inliers), float(score)
        if len(refined_inliers) >= to_refine:
            break
    assert best is not None  # there is at least one tree
    return best


# Number of shortest cycles through every edge from which its support is computed: six distinguish consistent
# edges from others.
_CYCLE_ROUNDS = 6
# Exponent of the inverse support in the cost of an edge in the first random tree; it falls to 0 in the last,
# because outliers that agree with each other have support, too.
_SUPPORT_EXPONENT = 2.0


def _draw_edge_costs(graph: PoseGraph, weights: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, E) random costs of edges, which depend on weight and support in the first sets, and not in the last.

    Support is biased: outliers that agree with each other in a triangle have more of it than inliers in a long
    cycle. The first tree is the one of least total cost: in a large graph, the shortest paths contain outliers.
    """
    cycles = (*find_cycle_basis(graph.count, graph.edges), *find_cycles_through_edges(graph, _CYCLE_ROUNDS, rng))
    randomness = np.linspace(0, 1, count)[:, None]
    cost = (weights * edge_support(graph, cycles)) ** (-_SUPPORT_EXPONENT * (1 - randomness))
    costs = np.asarray(cost * (1 - randomness + randomness * rng.exponential(size=(count, len(graph.edges)))))
    costs[0] *= np.where(find_minimum_tree(graph, 1 / weights), 1.0, _EXCLUDED)
    return costs


def _refine_tree(
    graph: PoseGraph, weights: Array, T_root_node: Array, gate: float, rng: np.random.Generator
) -> Array:
    """Poses that fit the inliers of a tree, after votes and robust least squares or directly: the better set.

    Votes and a robust loss repair the tree of a large graph, but may move the right one of a small graph away.
    """
    T = improve_by_votes(graph, weights, T_root_node, gate * _TREE_GATE_FACTOR, rng)
    T = optimize_poses_robustly(graph, T, gate)
    T = improve_by_votes(graph, weights, T, gate, rng)
    candidates = np.stack([_fit_inliers(graph, weights, start, gate) for start in (T, T_root_node)])
    return np.asarray(candidates[np.argmin(_score(graph, weights, candidates, gate)[0])])


def _fit_inliers(graph: PoseGraph, weights: Array, T_root_node: Array, gate: float) -> Array:
    """Least-squares poses over the inliers, repeated until the inliers stay the same."""
    T, inliers = T_root_node, _score(graph, weights, T_root_node[None], gate * _TREE_GATE_FACTOR)[1][0]
    for _ in range(_MAX_ROUNDS):
        if not graph.select_edges(inliers).find_reachable().all():
            break
        T = optimize_poses(graph, T, inliers.astype(np.float64))
        previous, inliers = inliers, _score(graph, weights, T[None], gate)[1][0]
        if np.array_equal(previous, inliers):
            break
    return T


def _score(graph: PoseGraph, weights: Array, T_root_node: Array, gate: float) -> tuple[Array, NDArray[np.bool_]]:
    """Scores of K sets of node poses by truncated squared residuals, and the inliers.

    Returns:
        (K,) scores, lower is better: 0 without inliers, minus its weight for an edge without error; and (K, E) the
        best edge of each pair where it is within the gate.
    """
    agreement = weights * np.maximum(1 - chi_squared(graph, T_root_node) / gate, 0.0)
    order = np.argsort(graph.pair_of_edge, kind="stable")
    sizes = np.bincount(graph.pair_of_edge)
    best = np.maximum.reduceat(agreement[:, order], np.cumsum(sizes) - sizes, axis=1) if len(sizes) else agreement
    inliers = (agreement > 0) & (agreement == best[:, graph.pair_of_edge])
    return -best.sum(axis=1), inliers

"""Consensus over spanning trees: the node poses that most edges agree with, for any errors of the others.

A tree of inliers gives all poses, and all inliers agree with them. Trees are drawn at random, edges of consistent
cycles more often. The best trees by truncated residuals of whole transforms are refined.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.config.settings import GraphSettings
from calgraph.geometry import Array
from calgraph.graph.cycles import edge_support, find_cycle_basis, find_cycles_through_edges
from calgraph.graph.graph_optimization import optimize_poses, optimize_poses_robustly
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution, chi_squared
from calgraph.graph.random_trees import compute_tree_poses, improve_by_votes
from calgraph.graph.tree_cuts import find_minimum_tree

# Cost factor that excludes an edge from a tree wherever there is another path.
_EXCLUDED = 1e9
# Most rounds of least squares over the inliers; they usually stay the same after two.
_MAX_ROUNDS = 5


def average_poses(
    graph: PoseGraph,
    rng: np.random.Generator,
    weights: Array | None = None,
    settings: GraphSettings = GraphSettings(),
) -> PoseGraphSolution:
    """The node poses that most pairs agree with, without start values, optimized over the inliers.

    Args:
        graph: connected; several edges of a pair are alternatives, of which the best is scored.
        rng: source of the trees.
        weights: (E,) of the edges, 0..1; uniform if None.
        settings: of the gates and the number of trees.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    graph.require_connected()
    if graph.count == 1:
        return PoseGraphSolution(np.eye(graph.dimension + 1)[None], np.zeros(len(graph.edges), dtype=np.bool_))
    weights = np.ones(len(graph.edges)) if weights is None else np.maximum(weights, settings.min_edge_weight)
    gate = float(chdtri(graph.information.shape[-1], settings.outlier_probability))
    edges = max(len(graph.edges), 1)
    count = int(np.clip(settings.tree_edges // edges, settings.min_trees, settings.max_trees))
    to_refine = int(
        np.clip(settings.refined_edges // edges, settings.min_refined_trees, settings.max_refined_trees)
    )
    starts = compute_tree_poses(graph, _draw_edge_costs(graph, weights, count, rng, settings))
    scores, inliers_of_tree = _score(graph, weights, starts, gate * settings.tree_gate_factor)
    best: PoseGraphSolution | None = None
    best_score, refined_inliers = np.inf, set[bytes]()
    for k in np.argsort(scores, kind="stable"):
        if inliers_of_tree[k].tobytes() in refined_inliers:
            continue
        refined_inliers.add(inliers_of_tree[k].tobytes())
        T = _refine_tree(graph, weights, starts[k], gate, rng, settings)
        (score,), (inliers,) = _score(graph, weights, T[None], gate)
        if best is None or score < best_score:
            best, best_score = PoseGraphSolution(T, inliers), float(score)
        if len(refined_inliers) >= to_refine:
            break
    assert best is not None  # there is at least one tree
    return best


def _draw_edge_costs(
    graph: PoseGraph, weights: Array, count: int, rng: np.random.Generator, settings: GraphSettings
) -> Array:
    """(count, E) random costs of edges, which depend on weight and support in the first sets, and not in the last.

    Support is biased: outliers that agree with each other in a triangle have more of it than inliers in a long
    cycle. The first tree is the one of least total cost: in a large graph, the shortest paths contain outliers.
    """
    cycles = (
        *find_cycle_basis(graph.count, graph.edges),
        *find_cycles_through_edges(graph, settings.cycle_rounds, rng),
    )
    randomness = np.linspace(0, 1, count)[:, None]
    cost = (weights * edge_support(graph, cycles, settings)) ** (-settings.support_exponent * (1 - randomness))
    costs = np.asarray(cost * (1 - randomness + randomness * rng.exponential(size=(count, len(graph.edges)))))
    costs[0] *= np.where(find_minimum_tree(graph, 1 / weights), 1.0, _EXCLUDED)
    return costs


def _refine_tree(
    graph: PoseGraph,
    weights: Array,
    T_root_node: Array,
    gate: float,
    rng: np.random.Generator,
    settings: GraphSettings,
) -> Array:
    """Poses that fit the inliers of a tree, after votes and robust least squares or directly: the better set.

    Votes and a robust loss repair the tree of a large graph, but may move the right one of a small graph away.
    """
    T = improve_by_votes(graph, weights, T_root_node, gate * settings.tree_gate_factor, rng, settings)
    T = optimize_poses_robustly(graph, T, gate, settings)
    T = improve_by_votes(graph, weights, T, gate, rng, settings)
    candidates = np.stack([_fit_inliers(graph, weights, start, gate, settings) for start in (T, T_root_node)])
    return np.asarray(candidates[np.argmin(_score(graph, weights, candidates, gate)[0])])


def _fit_inliers(
    graph: PoseGraph, weights: Array, T_root_node: Array, gate: float, settings: GraphSettings
) -> Array:
    """Least-squares poses over the inliers, repeated until the inliers stay the same."""
    T, inliers = T_root_node, _score(graph, weights, T_root_node[None], gate * settings.tree_gate_factor)[1][0]
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

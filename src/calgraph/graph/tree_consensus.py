"""Consensus over spanning trees: the poses that most edges agree with, however wrong the others are.

One tree of right edges alone gives all poses, and all right edges agree with them. Trees are drawn at random,
those of edges that fit into cycles more often; the best by truncated residuals of whole transforms are improved.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.graph.cycles import edge_support, find_cycle_basis, find_cycles_through_edges
from calgraph.graph.graph_optimization import optimize_poses, optimize_poses_robustly
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution, chi_squared
from calgraph.graph.random_trees import compute_tree_poses, improve_by_votes
from calgraph.ransac import select_best_of_groups

# An edge agrees unless its error is larger than by chance once in a thousand times.
_CHANCE = 0.001
# Noise adds up along a tree: its squared distances may be this many times larger before refinement.
_TREE_SCALE = 9.0
# Trees drawn: as many as make this many edges together, within limits.
_TREE_EDGES = 100_000
_FEWEST_TREES, _MOST_TREES = 8, 600
# Trees that are improved and judged again, likewise.
_FINAL_EDGES = 5_000
_FEWEST_FINALISTS, _MOST_FINALISTS = 1, 6
# Shortest cycles through every edge, on which the chances of being drawn rest.
_CYCLE_ROUNDS = 6
# An edge's cost is its support to this power, inverted, in the first trees; to ever lower powers in the next.
_BIAS = 2.0
# No path goes over an edge that costs so many times more, if there is another one.
_CLOSED = 1e9
# Whatever nobody trusts still holds together what nothing else does.
_LEAST_TRUST = 1e-3
# Rounds of least squares over the inliers, until they stay the same.
_ROUNDS = 5


def average_by_tree_consensus(
    graph: PoseGraph,
    rng: np.random.Generator,
    weights: Array | None = None,
    *,
    trees: int | None = None,
    finalists: int | None = None,
) -> PoseGraphSolution:
    """The poses that most pairs agree with, from no start, refined over the edges that agree.

    Args:
        graph: connected; several edges of a pair are alternatives, of which the best counts.
        rng: source of the trees.
        weights: (E,) how much each edge's agreement counts, 0..1; all alike without.
        trees: how many spanning trees to draw; without, as many as suit the graph's size.
        finalists: how many of them to improve and to judge again; likewise.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    graph.require_connected()
    if graph.count == 1:
        return PoseGraphSolution(np.eye(graph.dimension + 1)[None], np.zeros(len(graph.edges), dtype=np.bool_))
    trust = np.ones(len(graph.edges)) if weights is None else np.maximum(weights, _LEAST_TRUST)
    gate = float(chdtri(graph.information.shape[-1], _CHANCE))
    edges = max(len(graph.edges), 1)
    count = trees or int(np.clip(_TREE_EDGES // edges, _FEWEST_TREES, _MOST_TREES))
    final = finalists or int(np.clip(_FINAL_EDGES // edges, _FEWEST_FINALISTS, _MOST_FINALISTS))
    starts = compute_tree_poses(graph, _draw_edge_costs(graph, trust, count, rng))
    scores, agreeing = _score(graph, trust, starts, gate * _TREE_SCALE)
    best: PoseGraphSolution | None = None
    best_score, seen = np.inf, set[bytes]()
    for k in np.argsort(scores, kind="stable"):
        if agreeing[k].tobytes() in seen:
            continue
        seen.add(agreeing[k].tobytes())
        T = _refine(graph, trust, starts[k], gate, rng)
        (score,), (inliers,) = _score(graph, trust, T[None], gate)
        if best is None or score < best_score:
            best, best_score = PoseGraphSolution(T, inliers), float(score)
        if len(seen) >= final:
            break
    assert best is not None  # there is at least one tree
    return best


def _draw_edge_costs(graph: PoseGraph, trust: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, E) costs of edges: at first small for trusted ones that cycles support, at last blindly random.

    Wrong edges that agree with each other in a triangle look better than right ones in a long cycle. The first
    tree is the one of the best edges, however long its paths: in a large graph, paths of few edges lead over wrong
    ones.
    """
    cycles = (*find_cycle_basis(graph.count, graph.edges), *find_cycles_through_edges(graph, _CYCLE_ROUNDS, rng))
    chance = np.linspace(0, 1, count)[:, None]
    expensive = (trust * edge_support(graph, cycles)) ** (-_BIAS * (1 - chance))
    costs = np.asarray(expensive * (1 - chance + chance * rng.exponential(size=(count, len(graph.edges)))))
    costs[0] *= np.where(_cheapest_tree(graph, 1 / trust), 1.0, _CLOSED)
    return costs


def _cheapest_tree(graph: PoseGraph, costs: Array) -> NDArray[np.bool_]:
    """(E,) the edges of the tree of least costs (E,) in all."""
    # Of alternatives of one pair the cheapest; SciPy would add them up.
    best = select_best_of_groups(costs / costs.max(), graph.pair_of_edge)
    i, j = graph.edges[best].T
    tree = minimum_spanning_tree(coo_array((costs[best], (i, j)), shape=(graph.count, graph.count))).tocoo()
    chosen = np.isin(i * graph.count + j, tree.row * graph.count + tree.col)
    within = np.zeros(len(costs), dtype=np.bool_)
    within[np.flatnonzero(best)[chosen]] = True
    return within


def _refine(graph: PoseGraph, trust: Array, T_root_node: Array, gate: float, rng: np.random.Generator) -> Array:
    """Poses near a tree's that fit the edges which agree: by votes and robust least squares, or as the tree is.

    Votes and a forgiving loss repair a large graph's tree, but may lead a small graph's right one astray.
    """
    T = improve_by_votes(graph, trust, T_root_node, gate * _TREE_SCALE, rng)
    T = optimize_poses_robustly(graph, T, gate)
    T = improve_by_votes(graph, trust, T, gate, rng)
    settled = np.stack([_fit_inliers(graph, trust, start, gate) for start in (T, T_root_node)])
    return np.asarray(settled[np.argmin(_score(graph, trust, settled, gate)[0])])


def _fit_inliers(graph: PoseGraph, trust: Array, T_root_node: Array, gate: float) -> Array:
    """The least squares poses over the edges that agree, until they stay the same."""
    T, inliers = T_root_node, _score(graph, trust, T_root_node[None], gate * _TREE_SCALE)[1][0]
    for _ in range(_ROUNDS):
        if not graph.select_edges(inliers).find_reachable().all():
            break
        T = optimize_poses(graph, T, inliers.astype(np.float64))
        before, inliers = inliers, _score(graph, trust, T[None], gate)[1][0]
        if np.array_equal(before, inliers):
            break
    return T


def _score(graph: PoseGraph, trust: Array, T_root_node: Array, gate: float) -> tuple[Array, NDArray[np.bool_]]:
    """Scores of K sets of node poses: truncated squared residuals, summed over pairs, and who agrees.

    Returns:
        (K,) scores, the less the better: 0 without any agreement, and minus its trust for an edge that agrees
        exactly; and (K, E) the best edge of each pair where it is within the gate.
    """
    gains = trust * np.maximum(1 - chi_squared(graph, T_root_node) / gate, 0.0)
    order = np.argsort(graph.pair_of_edge, kind="stable")
    sizes = np.bincount(graph.pair_of_edge)
    best = np.maximum.reduceat(gains[:, order], np.cumsum(sizes) - sizes, axis=1) if len(sizes) else gains
    agree = (gains > 0) & (gains == best[:, graph.pair_of_edge])
    return -best.sum(axis=1), agree

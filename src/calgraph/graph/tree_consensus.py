"""Consensus over spanning trees: the node poses that most edges agree with, for any errors of the others.

A tree of inliers gives all poses, and all inliers agree with them. Trees are drawn at random, edges of consistent
cycles more often. The best trees by truncated residuals of whole transforms are refined.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array, se_n
from calgraph.graph.cycles import OUTLIER_PROBABILITY, edge_support, find_cycle_basis, find_cycles_through_edges
from calgraph.graph.graph_optimization import optimize_poses, optimize_poses_robustly
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution, chi_squared
from calgraph.graph.spanning_tree import find_minimum_tree

# Sweeps end when no node moves; this cap is not reached in practice.
_MAX_SWEEPS = 20
# (Proposal, edge) combinations evaluated in one batch, which bounds memory.
_CHUNK = 200_000


def compute_tree_poses(graph: PoseGraph, costs: Array) -> Array:
    """Node poses along the shortest-path trees from the root (Dijkstra), for a batch of edge costs.

    Every spanning tree is the shortest-path tree of some costs, so random costs make random trees. Shallow trees
    are more frequent, along whose few edges less noise accumulates.

    Args:
        graph: connected.
        costs: (K, E) positive.

    Returns:
        T_root_node (K, N, n+1, n+1).
    """
    sets = np.arange(len(costs))
    start = np.concatenate([graph.edges[:, 0], graph.edges[:, 1]])
    end = np.concatenate([graph.edges[:, 1], graph.edges[:, 0]])
    T_start_end = np.concatenate([graph.T_i_j, se_n.inverse(graph.T_i_j)])
    both_ways = np.concatenate([costs, costs], axis=1)
    T = np.zeros((len(costs), graph.count, *graph.T_i_j.shape[1:])) + np.eye(graph.T_i_j.shape[-1])
    distance = np.zeros((len(costs), graph.count))
    in_tree = np.zeros(distance.shape, dtype=np.bool_)
    in_tree[:, graph.root] = True
    # Distance at which a directed edge arrives, while it leaves the tree; infinite otherwise.
    arrival = np.full(both_ways.shape, np.inf)
    leaving, entering = _group_by_node(start, graph.count), _group_by_node(end, graph.count)
    added = np.full(len(costs), graph.root)
    for _ in range(graph.count - 1):
        out, into = leaving[added], entering[added]
        rows = sets[:, None]
        # Padding points one past the last edge.
        out_edge = np.minimum(out, len(start) - 1)
        enters = (out < len(start)) & ~in_tree[rows, end[out_edge]]
        k, at = np.nonzero(enters)
        e = out[k, at]
        arrival[k, e] = distance[k, start[e]] + both_ways[k, e]
        k, at = np.nonzero(into < len(start))
        arrival[k, into[k, at]] = np.inf
        best = np.argmin(arrival, axis=1)
        added = end[best]
        in_tree[sets, added] = True
        distance[sets, added] = arrival[sets, best]
        T[sets, added] = T[sets, start[best]] @ T_start_end[best]
    return T


# Maximum number of poses proposed to one node: among 30 random edges of which 90 % are wrong, one is right with
# 96 %.
_MAX_PROPOSALS = 30
# Increase of votes, in edges of full weight, from which a node moves: less than one right edge, more than the
# noise of the others.
_MIN_VOTE_GAIN = 0.5


def improve_by_votes(
    graph: PoseGraph, weights: Array, T_root_node: Array, gate: float, rng: np.random.Generator
) -> Array:
    """Moves single nodes to the pose that an edge of a neighbour predicts where more of their edges then agree.

    Args:
        graph: any.
        weights: (E,) of the edges.
        T_root_node: (N, n+1, n+1).
        gate: squared Mahalanobis distance up to which an edge agrees.
        rng: selects the nodes that move in a sweep.
    """
    voting = _Voting(graph, weights, rng, _MAX_PROPOSALS)
    T = T_root_node.copy()
    for _ in range(_MAX_SWEEPS):
        proposals, gains = voting.count_votes(T, gate)
        movers = np.flatnonzero(gains > _MIN_VOTE_GAIN)
        if not len(movers):
            break
        # The gain of a node assumes that its neighbours stay: about half move, the one of largest gain always.
        moving = movers[(rng.random(len(movers)) < 0.5) | (movers == movers[np.argmax(gains[movers])])]
        T[moving] = proposals[moving]
    return T


class _Voting:
    """Which edges vote on which proposals, which depends on the graph alone."""

    def __init__(self, graph: PoseGraph, weights: Array, rng: np.random.Generator, max_proposals: int) -> None:
        self.graph, self.weights = graph, weights
        edges = len(graph.edges)
        self.start = np.concatenate([graph.edges[:, 0], graph.edges[:, 1]])
        self.end = np.concatenate([graph.edges[:, 1], graph.edges[:, 0]])
        self.T_start_end = np.concatenate([graph.T_i_j, se_n.inverse(graph.T_i_j)])
        self.edge = np.tile(np.arange(edges), 2)
        self.degree = np.bincount(self.end, weights[self.edge], minlength=graph.count)
        into = _group_by_node(self.end, graph.count, rng)
        node = np.repeat(np.arange(graph.count), into.shape[1] * min(into.shape[1], max_proposals))
        voter = np.repeat(into, min(into.shape[1], max_proposals), axis=1).ravel()
        proposal = np.tile(into[:, :max_proposals], (1, into.shape[1])).ravel()
        real = (voter < 2 * edges) & (proposal < 2 * edges)
        self.voter, self.proposal, self.node = voter[real], proposal[real], node[real]

    def count_votes(self, T: Array, gate: float) -> tuple[Array, Array]:
        """The best proposal for every node (N, n+1, n+1), and its gain of votes over the current pose (N,)."""
        ends = np.arange(len(self.start))
        current = np.bincount(self.end, self._agreement(T, T[self.end], ends, gate), minlength=len(T))
        # A node with the majority of its edges keeps its pose: no other pose can have more votes.
        contested = current < 0.5 * self.degree
        contested[self.graph.root] = False
        proposals = T[self.start] @ self.T_start_end
        votes = np.zeros(len(self.start))
        open_votes = np.flatnonzero(contested[self.node])
        for chunk in np.array_split(open_votes, len(open_votes) // _CHUNK + 1):
            voter, proposal = self.voter[chunk], self.proposal[chunk]
            agreement = self._agreement(T, proposals[proposal], voter, gate)
            votes += np.bincount(proposal, agreement, minlength=len(votes))
        order = np.argsort(votes, kind="stable")
        best = np.zeros(len(T), dtype=np.intp)
        best[self.end[order]] = order
        gains = votes[best] - current
        gains[~contested] = 0.0
        return proposals[best], gains

    def _agreement(self, T: Array, T_end: Array, voter: NDArray[np.intp], gate: float) -> Array:
        """(V,) agreement of directed edges with poses of their end: the weight if exact, 0 at the gate."""
        e = self.edge[voter]
        forwards = (voter < len(self.graph.edges))[:, None, None]
        T_start = T[self.start[voter]]
        predicted = se_n.inverse(np.where(forwards, T_start, T_end)) @ np.where(forwards, T_end, T_start)
        r = se_n.difference(predicted, self.graph.T_i_j[e])
        chi2 = np.einsum("vi,vi->v", r, (self.graph.information[e] @ r[..., None])[..., 0])
        return np.asarray(self.weights[e] * np.maximum(1 - chi2 / gate, 0.0))


def _group_by_node(
    nodes: NDArray[np.intp], count: int, rng: np.random.Generator | None = None
) -> NDArray[np.intp]:
    """(N, D) indices of the entries of ``nodes`` equal to each node, in random order; padded with len(nodes)."""
    order = np.arange(len(nodes)) if rng is None else rng.permutation(len(nodes))
    order = order[np.argsort(nodes[order], kind="stable")]
    degrees = np.bincount(nodes, minlength=count)
    columns = np.arange(len(nodes)) - np.repeat(np.cumsum(degrees) - degrees, degrees)
    table = np.full((count, int(degrees.max(initial=0))), len(nodes), dtype=np.intp)
    table[nodes[order], columns] = order
    return table


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

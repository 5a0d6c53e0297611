"""Random spanning trees of a graph, in batches, and moves of single nodes to poses that more edges support."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import PoseGraph

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

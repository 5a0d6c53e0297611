"""Cycles of a graph: around each of them relative poses multiply to the identity, unless one of them is wrong."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import chdtri

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import Edges, PoseGraph

Cycle = NDArray[np.intp]
"""(L, 2) in the order of the walk: number of the edge, and 1 or -1 as it is walked from i to j or from j to i."""

Adjacency = list[list[tuple[int, int, int]]]
"""For every node the steps that leave it: neighbour, edge, direction."""

# A cycle agrees with the identity unless its error is larger than by chance once in a thousand times.
_CHANCE = 0.001
# Information added so that directions left open have a large covariance instead of none: 100 m or rad.
_OPEN = 1e-4


def find_cycle_basis(count: int, edges: Edges) -> tuple[Cycle, ...]:
    """A basis of a graph's cycles, short ones where there are short ones.

    The graph is grown edge by edge; each edge that joins two nodes already connected closes a cycle with the
    shortest path between them. So every cycle has an edge that none before it has, which makes them independent,
    and rings of any length are covered, which triangles alone are not. Parallel edges make cycles of two.

    Args:
        count: number of nodes.
        edges: (E, 2) nodes; need not be connected.

    Returns:
        E - N + C cycles, where C is the number of connected parts.
    """
    tree = _forest(count, edges)
    steps: Adjacency = [[] for _ in range(count)]
    for e in np.flatnonzero(tree):
        _add(steps, edges, int(e))
    cycles = []
    for e in np.flatnonzero(~tree):
        back = _shortest_path(steps, int(edges[e, 1]), int(edges[e, 0]))
        cycles.append(np.array([(int(e), 1), *(back or ())], dtype=np.intp))
        _add(steps, edges, int(e))
    return tuple(cycles)


def find_triangles(count: int, edges: Edges) -> tuple[Cycle, ...]:
    """All cycles of three edges, as the paper takes them."""
    steps: Adjacency = [[] for _ in range(count)]
    for e in range(len(edges)):
        _add(steps, edges, e)
    found = []
    for a in range(count):
        for b, ab, ab_way in steps[a]:
            for c, bc, bc_way in steps[b] if b > a else ():
                closing = (step for step in steps[c] if step[0] == a) if c > b else ()
                found += [
                    np.array([(ab, ab_way), (bc, bc_way), (ca, way)], dtype=np.intp) for _, ca, way in closing
                ]
    return tuple(found)


def find_cycles_through_edges(graph: PoseGraph, rounds: int, rng: np.random.Generator) -> tuple[Cycle, ...]:
    """Up to ``rounds`` shortest cycles through every edge, other ones each round where there are several."""
    pairs, found = graph.pair_of_edge, []
    steps: Adjacency = [[] for _ in range(graph.count)]
    for e in range(len(graph.edges)):
        _add(steps, graph.edges, e)
    for _ in range(rounds):
        steps = [[node[k] for k in rng.permutation(len(node))] for node in steps]
        for e, (i, j) in enumerate(graph.edges):
            back = _shortest_path(steps, int(j), int(i), avoid=(pairs, int(pairs[e])))
            if back is not None:
                found.append(np.array([(e, 1), *back], dtype=np.intp))
    return tuple(found)


def incidence_matrix(cycles: Sequence[Cycle], edges: int) -> csr_array:
    """Sparse matrix (cycles, edges) of directions, ±1: what it maps relative angles to is zero."""
    rows = np.repeat(np.arange(len(cycles)), [len(c) for c in cycles])
    walk = np.concatenate([*cycles, np.zeros((0, 2), dtype=np.intp)])
    return csr_array((walk[:, 1].astype(np.float64), (rows, walk[:, 0])), shape=(len(cycles), edges))


def check_consistency(graph: PoseGraph, cycles: Sequence[Cycle]) -> NDArray[np.bool_]:
    """Whether the poses around each cycle multiply to the identity, within their covariances."""
    dof = graph.information.shape[-1]
    covariance = np.asarray(np.linalg.inv(graph.information + _OPEN * np.eye(dof)), dtype=np.float64)
    # Edges walked forwards come first, the same edges walked backwards after them.
    T = np.concatenate([graph.T_i_j, se_n.inverse(graph.T_i_j)])
    S = np.concatenate([covariance, se_n.inverse_covariance(graph.T_i_j, covariance)])
    lengths = np.array([len(c) for c in cycles], dtype=np.intp)
    agree = np.zeros(len(cycles), dtype=np.bool_)
    for length in np.unique(lengths):
        members = np.flatnonzero(lengths == length)
        walks = np.stack([cycles[int(m)] for m in members])
        directed = np.where(walks[..., 1] > 0, walks[..., 0], walks[..., 0] + len(graph.edges))
        error, spread = T[directed[:, 0]], S[directed[:, 0]]
        for step in directed.T[1:]:
            spread = se_n.compose_covariance(error, spread, S[step], se_n.translation(T[step]))
            error = error @ T[step]
        r = se_n.difference(error, np.eye(error.shape[-1]))
        chi2 = np.einsum("ci,ci->c", r, np.linalg.solve(spread, r[..., None])[..., 0])
        agree[members] = chi2 <= chdtri(dof, _CHANCE)
    return agree


def edge_support(graph: PoseGraph, cycles: Sequence[Cycle]) -> Array:
    """(E,) the share of consistent cycles among those through each edge; near a half where there are few."""
    through = abs(incidence_matrix(cycles, len(graph.edges))).T
    return np.asarray((through @ check_consistency(graph, cycles) + 0.5) / (through @ np.ones(len(cycles)) + 1.0))


def _forest(count: int, edges: Edges) -> NDArray[np.bool_]:
    """(E,) a breadth-first spanning forest: shallow, so that the first cycles are short already."""
    steps: Adjacency = [[] for _ in range(count)]
    for e in range(len(edges)):
        _add(steps, edges, e)
    chosen, seen = np.zeros(len(edges), dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    for start in range(count):
        queue = deque() if seen[start] else deque([start])
        seen[start] = True
        while queue:
            for node, edge, _ in steps[queue.popleft()]:
                if not seen[node]:
                    seen[node] = chosen[edge] = True
                    queue.append(node)
    return chosen


def _add(steps: Adjacency, edges: Edges, e: int) -> None:
    i, j = int(edges[e, 0]), int(edges[e, 1])
    steps[i].append((j, e, 1))
    steps[j].append((i, e, -1))


def _shortest_path(
    steps: Adjacency, start: int, end: int, avoid: tuple[NDArray[np.intp], int] | None = None
) -> list[tuple[int, int]] | None:
    """Edges and directions from start to end by breadth-first search from both; None if there is no path.

    Edges whose label is the one to ``avoid`` are not walked.
    """
    labels, forbidden = avoid if avoid is not None else (None, -1)
    # Where each node was reached from: previous node, edge, and direction of that step away from its own end.
    reached: tuple[dict[int, tuple[int, int, int]], ...] = ({start: (-1, -1, 0)}, {end: (-1, -1, 0)})
    fronts = [[start], [end]]
    while fronts[0] and fronts[1]:
        side = 0 if len(fronts[0]) <= len(fronts[1]) else 1
        front: list[int] = []
        for node in fronts[side]:
            for neighbour, edge, way in steps[node]:
                if neighbour in reached[side] or (labels is not None and labels[edge] == forbidden):
                    continue
                reached[side][neighbour] = (node, edge, way)
                if neighbour in reached[1 - side]:
                    return _walk(reached[0], neighbour)[::-1] + [(e, -w) for e, w in _walk(reached[1], neighbour)]
                front.append(neighbour)
        fronts[side] = front
    return None


def _walk(reached: dict[int, tuple[int, int, int]], node: int) -> list[tuple[int, int]]:
    """The steps by which a node was reached, the last first."""
    walk: list[tuple[int, int]] = []
    while True:
        node, edge, way = reached[node]
        if edge < 0:
            return walk
        walk.append((edge, way))

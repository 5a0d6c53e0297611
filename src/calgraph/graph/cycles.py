"""Cycles of a graph. The product of the relative poses around a cycle is the identity if all are right."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import chdtri

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import Edges, PoseGraph

Cycle = NDArray[np.intp]
"""(L, 2) in traversal order: index of the edge, and 1 if it is traversed from i to j, -1 from j to i."""

Adjacency = list[list[tuple[int, int, int]]]
"""For every node its incident edges: neighbour, edge, direction."""

Steps = dict[int, tuple[int, int, int] | None]
"""For every node of a search the node before it, the edge, and its direction away from the start; None there."""

# Information added to make the covariance of unobserved directions finite: 100 m or rad.
_MIN_INFORMATION = 1e-4


def list_incident_edges(count: int, edges: Edges) -> Adjacency:
    """The incident edges of every node."""
    adjacency: Adjacency = [[] for _ in range(count)]
    for e in range(len(edges)):
        _add_edge(adjacency, edges, e)
    return adjacency


def find_cycle_basis(count: int, edges: Edges) -> tuple[Cycle, ...]:
    """A basis of a graph's cycles, of short cycles where possible.

    The graph is built edge by edge; each edge between two nodes already connected closes a cycle with the shortest
    path between them. Every cycle has an edge that no cycle before it has, which makes them independent. Rings of
    any length are covered, which triangles do not achieve. Parallel edges make cycles of two.

    Args:
        count: number of nodes.
        edges: (E, 2) nodes; need not be connected.

    Returns:
        E - N + C cycles, where C is the number of connected parts.
    """
    tree = _forest(count, edges)
    adjacency: Adjacency = [[] for _ in range(count)]
    for e in np.flatnonzero(tree):
        _add_edge(adjacency, edges, int(e))
    cycles = []
    for e in np.flatnonzero(~tree):
        back = _shortest_path(adjacency, int(edges[e, 1]), int(edges[e, 0]))
        cycles.append(np.array([(int(e), 1), *(back or ())], dtype=np.intp))
        _add_edge(adjacency, edges, int(e))
    return tuple(cycles)


def find_cycles_through_edges(graph: PoseGraph, rounds: int, rng: np.random.Generator) -> tuple[Cycle, ...]:
    """Up to ``rounds`` shortest cycles through every edge; ties are broken at random in each round."""
    pairs, found = graph.pair_of_edge, []
    adjacency = list_incident_edges(graph.count, graph.edges)
    for _ in range(rounds):
        adjacency = [[edges[k] for k in rng.permutation(len(edges))] for edges in adjacency]
        for e, (i, j) in enumerate(graph.edges):
            back = _shortest_path(adjacency, int(j), int(i), avoid=(pairs, int(pairs[e])))
            if back is not None:
                found.append(np.array([(e, 1), *back], dtype=np.intp))
    return tuple(found)


def incidence_matrix(cycles: Sequence[Cycle], edges: int) -> csr_array:
    """Sparse matrix (cycles, edges) of directions, ±1."""
    rows = np.repeat(np.arange(len(cycles)), [len(c) for c in cycles])
    directed = np.concatenate([*cycles, np.zeros((0, 2), dtype=np.intp)])
    return csr_array((directed[:, 1].astype(np.float64), (rows, directed[:, 0])), shape=(len(cycles), edges))


# Probability with which a right edge, or a cycle of right edges, is taken for an outlier: rare in a graph of ten
# sensors, and 4.0 (SE(2)) or 4.7 (SE(3)) standard deviations.
OUTLIER_PROBABILITY = 1e-3


def check_consistency(graph: PoseGraph, cycles: Sequence[Cycle]) -> NDArray[np.bool_]:
    """Whether the poses around each cycle multiply to the identity, within their covariances."""
    dof = graph.information.shape[-1]
    covariance = np.asarray(np.linalg.inv(graph.information + _MIN_INFORMATION * np.eye(dof)), dtype=np.float64)
    # The edges in forward direction come first, the same edges reversed after them.
    T = np.concatenate([graph.T_i_j, se_n.inverse(graph.T_i_j)])
    S = np.concatenate([covariance, se_n.inverse_covariance(graph.T_i_j, covariance)])
    lengths = np.array([len(c) for c in cycles], dtype=np.intp)
    consistent = np.zeros(len(cycles), dtype=np.bool_)
    for length in np.unique(lengths):
        members = np.flatnonzero(lengths == length)
        members_edges = np.stack([cycles[int(m)] for m in members])
        directed = np.where(
            members_edges[..., 1] > 0, members_edges[..., 0], members_edges[..., 0] + len(graph.edges)
        )
        error, error_covariance = T[directed[:, 0]], S[directed[:, 0]]
        for step in directed.T[1:]:
            error_covariance = se_n.compose_covariance(error, error_covariance, S[step], se_n.translation(T[step]))
            error = error @ T[step]
        r = se_n.difference(error, np.eye(error.shape[-1]))
        chi2 = np.einsum("ci,ci->c", r, np.linalg.solve(error_covariance, r[..., None])[..., 0])
        consistent[members] = chi2 <= chdtri(dof, OUTLIER_PROBABILITY)
    return consistent


def edge_support(graph: PoseGraph, cycles: Sequence[Cycle]) -> Array:
    """(E,) share of consistent cycles among those through each edge, shrunk to one half where there are few."""
    through = abs(incidence_matrix(cycles, len(graph.edges))).T
    return np.asarray((through @ check_consistency(graph, cycles) + 0.5) / (through @ np.ones(len(cycles)) + 1.0))


def _forest(count: int, edges: Edges) -> NDArray[np.bool_]:
    """(E,) the edges of a breadth-first spanning forest, which is shallow and gives short cycles."""
    adjacency = list_incident_edges(count, edges)
    chosen, visited = np.zeros(len(edges), dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    for start in range(count):
        queue = deque() if visited[start] else deque([start])
        visited[start] = True
        while queue:
            for node, edge, _ in adjacency[queue.popleft()]:
                if not visited[node]:
                    visited[node] = chosen[edge] = True
                    queue.append(node)
    return chosen


def _add_edge(adjacency: Adjacency, edges: Edges, e: int) -> None:
    i, j = int(edges[e, 0]), int(edges[e, 1])
    adjacency[i].append((j, e, 1))
    adjacency[j].append((i, e, -1))


def _shortest_path(
    adjacency: Adjacency, start: int, end: int, avoid: tuple[NDArray[np.intp], int] | None = None
) -> list[tuple[int, int]] | None:
    """Edges and directions of a path from start to end (bidirectional breadth-first search); None without one.

    Edges whose label is the one to ``avoid`` are not traversed.
    """
    labels, forbidden = avoid if avoid is not None else (None, -1)
    reached: tuple[Steps, Steps] = ({start: None}, {end: None})
    fronts = [[start], [end]]
    while fronts[0] and fronts[1]:
        side = 0 if len(fronts[0]) <= len(fronts[1]) else 1
        front: list[int] = []
        for node in fronts[side]:
            for neighbour, edge, direction in adjacency[node]:
                if neighbour in reached[side] or (labels is not None and labels[edge] == forbidden):
                    continue
                reached[side][neighbour] = (node, edge, direction)
                if neighbour in reached[1 - side]:
                    first, second = (_trace_back(part, neighbour) for part in reached)
                    return first[::-1] + [(e, -d) for e, d in second]
                front.append(neighbour)
        fronts[side] = front
    return None


def _trace_back(reached: Steps, node: int) -> list[tuple[int, int]]:
    """The edges by which a node was reached, the last first."""
    path: list[tuple[int, int]] = []
    while step := reached[node]:
        node, edge, direction = step
        path.append((edge, direction))
    return path

"""Scanners whose pose is contradicted by hypotheses with more evidence than those that it rests on.

People who walk side by side are associated wrongly by several scanners, so that wrong pairs agree with each
other, and the number of agreeing pairs is a weak test. The test here compares evidence: the best hypothesis that
supports the pose of a part of the network against the best one that contradicts it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.spanning_tree import fundamental_cuts
from calgraph.network.graph.network_graph import edge_evidence
from calgraph.network.pairs.scanner_pair import (
    MIN_COUPLE_SHIFT,
    SAME_ANGLE,
    SAME_POSITION,
    SAME_TURN,
    ScannerPairEstimate,
)


@dataclass(frozen=True, eq=False)
class ConflictingEvidence:
    """A part of a network whose pose better evidence contradicts."""

    part: NDArray[np.bool_]
    """(N,) its scanners, without the root."""
    T_root_node: Array
    """(N, 3, 3) all poses, with the part moved to where the better evidence puts it."""
    weaker_edges: NDArray[np.bool_]
    """(E,) edges between the part and the rest that contradict the moved poses and have less evidence."""
    reason: str
    """Why the estimated pose is in conflict."""


def find_conflicting_evidence(
    graph: PoseGraph, names: Sequence[str], pairs: Sequence[ScannerPairEstimate], solution: PoseGraphSolution
) -> ConflictingEvidence | None:
    """The largest part of a network that a hypothesis with more evidence would put elsewhere; None without one.

    Each edge of the maximum spanning tree by evidence defines a fundamental cut, across which it is the edge of
    most evidence among the inliers. An outlier across the cut that has more evidence, and contradicts the poses,
    is a conflict of the part without the root.

    Args:
        graph: of :func:`build_network_graph`.
        names: its scanners.
        pairs: as given to :func:`build_network_graph`.
        solution: the estimated poses and their inliers.
    """
    evidence = edge_evidence(names, pairs)
    i, j = graph.edges.T
    contradicts, distance = _contradicting_edges(graph, solution.T_root_node)
    conflicting = ~solution.inliers & contradicts
    cuts = fundamental_cuts(graph, np.where(solution.inliers, evidence, 0.0))
    for tree_edge, part in sorted(cuts, key=lambda cut: -int(cut[1].sum())):
        across = part[i] != part[j]
        stronger = np.flatnonzero(conflicting & across & (evidence > evidence[tree_edge]))
        if not len(stronger):
            continue
        best = stronger[np.argmax(evidence[stronger])]
        T = move_part(graph, solution.T_root_node, part, int(best))
        against, supporting = (" and ".join(names[int(k)] for k in graph.edges[e]) for e in (best, tree_edge))
        reason = f"{against} put it {distance[best]:.1f} m elsewhere, with better evidence than {supporting} have"
        weaker = across & _contradicting_edges(graph, T)[0] & (evidence < evidence[best])
        weaker[tree_edge] = True  # also where it differs from the moved poses by less than the limits
        return ConflictingEvidence(part, T, weaker, reason)
    return None


def _contradicting_edges(graph: PoseGraph, T_root_node: Array) -> tuple[NDArray[np.bool_], Array]:
    """(E,) which edges contradict poses, and by what distance, m."""
    i, j = graph.edges.T
    error = se2.difference(se2.inverse(T_root_node[i]) @ T_root_node[j], graph.T_i_j)
    distance = np.linalg.norm(error[:, :2], axis=1)
    return (distance > SAME_POSITION) | (np.abs(error[:, 2]) > SAME_ANGLE), distance


def move_part(graph: PoseGraph, T_root_node: Array, part: NDArray[np.bool_], edge: int) -> Array:
    """The poses (N, 3, 3) with a part moved as a whole to where an edge puts it."""
    i, j = graph.edges[edge]
    T_i_j = graph.T_i_j[edge]
    fixed, inside, T_fixed_inside = (i, j, T_i_j) if part[j] else (j, i, se2.inverse(T_i_j))
    moved = T_root_node.copy()
    moved[part] = T_root_node[fixed] @ T_fixed_inside @ se2.inverse(T_root_node[inside]) @ T_root_node[part]
    return moved


@dataclass(frozen=True)
class AmbiguousPart:
    """Scanners that may as well be elsewhere."""

    nodes: tuple[int, ...]
    """Without the root."""
    pair: tuple[int, int]
    """The pair that may be matched in another way."""
    distance: float
    """From the position of the second of that pair, relative to the first, to the other one, m."""
    rotation: float
    """From its angle to the other one, rad."""


# Ratio of the evidence of another place of a part of the network to that of its place, above which it is
# ambiguous: 0.4 at most in 343 pairs of offices, labs and halls without couples, and above 0.7 in 10 of 11 wrong
# pairs of halls with a couple and no other people.
_MAX_AMBIGUITY = 0.7


def find_ambiguous_parts(graph: PoseGraph, evidence: Array, solution: PoseGraphSolution) -> list[AmbiguousPart]:
    """Finds the parts of a network for which another pose has nearly as much evidence as the estimated one.

    Each edge of the maximum spanning tree by evidence defines a fundamental cut. The evidence of the edges across
    the cut that agree with the poses is compared with that of the edges that agree with the poses where the part
    is moved to the place that an outlier across the cut implies.

    Args:
        graph: of :func:`build_network_graph`.
        evidence: (E,) of its edges.
        solution: the estimated poses and their inliers.
    """
    i, j = graph.edges.T
    differing, distance, rotation = _differing(graph, solution.T_root_node)
    found = []
    for _, part in fundamental_cuts(graph, np.where(solution.inliers, evidence, 0.0)):
        across = part[i] != part[j]
        chosen = float(evidence[across & solution.inliers].sum())
        others = np.flatnonzero(across & differing)
        edges_across, evidence_across = graph.select_edges(across), evidence[across]
        for edge in others[np.argsort(-evidence[others], kind="stable")].tolist():
            T = move_part(graph, solution.T_root_node, part, edge)
            agreeing = ~_differing(edges_across, T)[0]
            if float(evidence_across[agreeing].sum()) <= _MAX_AMBIGUITY * chosen:
                continue
            nodes = tuple(np.flatnonzero(part).tolist())
            found.append(AmbiguousPart(nodes, (int(i[edge]), int(j[edge])), distance[edge], rotation[edge]))
            break
    return found


def _differing(graph: PoseGraph, T_root_node: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Which edges (E,) differ from poses by more than equal hypotheses do; distances, m, and angles, rad."""
    i, j = graph.edges.T
    error = se2.difference(se2.inverse(T_root_node[i]) @ T_root_node[j], graph.T_i_j)
    distance, rotation = np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])
    return (distance > MIN_COUPLE_SHIFT) | (rotation > SAME_TURN), distance, rotation

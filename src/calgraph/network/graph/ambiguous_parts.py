"""Parts of a network whose pose is ambiguous: other hypotheses explain the tracks nearly as well.

The two people of a couple match correctly and crosswise: a pair alone often does not determine which is right.
Cycles do, where pairs of other scanners agree with one of both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.spanning_tree import fundamental_cuts
from calgraph.network.graph.conflicting_evidence import move_part
from calgraph.network.pairs.scanner_pair import MIN_COUPLE_SHIFT, SAME_TURN


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

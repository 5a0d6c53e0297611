"""Scanners whose place in a network is not the only one that fits: better evidence would put them elsewhere.

People who walk alike are taken for one by several scanners at once, so that wrong pairs agree with each other:
their number says little. Whether a part of the network is held by the best that is known of it says more.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.network_graph import edge_evidence
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.tree_cuts import fundamental_cuts
from calgraph.pairwise import ScannerPairEstimate

# A hypothesis farther from the pose that was found puts the scanner elsewhere, m and rad.
_ELSEWHERE = (0.5, np.radians(8))


@dataclass(frozen=True, eq=False)
class ConflictingEvidence:
    """A part of a network that better evidence would put elsewhere."""

    part: NDArray[np.bool_]
    """(N,) its scanners; the root is not among them."""
    T_root_node: Array
    """(N, 3, 3) all poses, with the part where the better evidence puts it."""
    weaker_edges: NDArray[np.bool_]
    """(E,) edges between the part and the rest that contradict this, with less evidence."""
    reason: str
    """The reason."""


def find_conflicting_evidence(
    graph: PoseGraph, names: Sequence[str], pairs: Sequence[ScannerPairEstimate], averaged: PoseGraphSolution
) -> ConflictingEvidence | None:
    """The largest part of a network that better evidence would put elsewhere, if there is any.

    Every tie of the tree of best evidence cuts the network in two, and is the best that holds the two together. If
    a hypothesis across the cut has more evidence and contradicts, the part without the root is in doubt.

    Args:
        graph: of :func:`network_graph`.
        names: its scanners.
        pairs: as handed to :func:`network_graph`.
        averaged: the poses found, and the edges that agree.
    """
    worth = edge_evidence(names, pairs)
    i, j = graph.edges.T
    elsewhere, apart = _contradicting_edges(graph, averaged.T_root_node)
    rivals = ~averaged.inliers & elsewhere
    by_size = sorted(
        fundamental_cuts(graph, np.where(averaged.inliers, worth, 0.0)), key=lambda cut: -int(cut[1].sum())
    )
    for tie, part in by_size:
        across = part[i] != part[j]
        against = np.flatnonzero(rivals & across & (worth > worth[tie]))
        if not len(against):
            continue
        best = against[np.argmax(worth[against])]
        T = _move_part(graph, averaged.T_root_node, part, int(best))
        rival, own = (" and ".join(names[int(k)] for k in graph.edges[edge]) for edge in (best, tie))
        said = f"{rival} put it {apart[best]:.1f} m elsewhere, with better evidence than {own} have for its place"
        weaker = across & _contradicting_edges(graph, T)[0] & (worth < worth[best])
        weaker[tie] = True  # even if it is so far from the poses that it hardly contradicts
        return ConflictingEvidence(part, T, weaker, said)
    return None


def _contradicting_edges(graph: PoseGraph, T_root_node: Array) -> tuple[NDArray[np.bool_], Array]:
    """(E,) which edges put their scanners elsewhere than poses do, and by how many metres."""
    i, j = graph.edges.T
    off = se2.difference(se2.inverse(T_root_node[i]) @ T_root_node[j], graph.T_i_j)
    apart = np.linalg.norm(off[:, :2], axis=1)
    return (apart > _ELSEWHERE[0]) | (np.abs(off[:, 2]) > _ELSEWHERE[1]), apart


def _move_part(graph: PoseGraph, T_root_node: Array, part: NDArray[np.bool_], edge: int) -> Array:
    """The poses (N, 3, 3) with a part moved as a whole to where an edge puts it."""
    i, j = graph.edges[edge]
    T_i_j = graph.T_i_j[edge]
    here, there, T_here_there = (i, j, T_i_j) if part[j] else (j, i, se2.inverse(T_i_j))
    moved = T_root_node.copy()
    moved[part] = T_root_node[here] @ T_here_there @ se2.inverse(T_root_node[there]) @ T_root_node[part]
    return moved

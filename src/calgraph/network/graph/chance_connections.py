"""Parts of a network that only matches by chance connect to the root.

Several such matches of a part are no better than one: where two scanners tracked the same person, both match
any other person at the same speed, with poses that agree.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.pairs.candidate_pairs import label_parts

Flags = NDArray[np.bool_]


def find_chance_connections(graph: PoseGraph, solution: PoseGraphSolution, by_chance: Flags) -> Flags:
    """Finds the edges by chance between parts of a network that no other inlier connects.

    Args:
        graph: of the network.
        solution: the estimated poses and their inliers.
        by_chance: (E,) edges whose matches may be by chance.

    Returns:
        (E,) mask.
    """
    connecting = graph.edges[solution.inliers & ~by_chance]
    part = label_parts(graph.count, {(int(a), int(b)) for a, b in connecting})
    i, j = graph.edges.T
    return np.asarray(by_chance & (part[i] != part[j]))

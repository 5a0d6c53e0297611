"""The graph of sensors: connectivity and start values."""

from calgraph.graph.adjustment import translations
from calgraph.graph.averaging import Method, average, averaged_tree, pose_graph
from calgraph.graph.cycles import Cycle, cycle_basis, triangles
from calgraph.graph.network import covariances, network_graph
from calgraph.graph.pose_graph import Averaged, PoseGraph
from calgraph.graph.rotation_averaging import chained, irls_l1, l1mc, spectral
from calgraph.graph.tree import SpanningTree, spanning_tree
from calgraph.graph.voting import consensus_trees

__all__ = [
    "Averaged",
    "Cycle",
    "Method",
    "PoseGraph",
    "SpanningTree",
    "average",
    "averaged_tree",
    "chained",
    "consensus_trees",
    "covariances",
    "cycle_basis",
    "irls_l1",
    "l1mc",
    "network_graph",
    "pose_graph",
    "spanning_tree",
    "spectral",
    "translations",
    "triangles",
]  # fmt: skip

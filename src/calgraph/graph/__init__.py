"""The graph of sensors: connectivity and start values."""

from calgraph.graph.averaging import Method, Start, average, averaged_tree, pose_graph, start_poses
from calgraph.graph.cycles import Cycle, cycle_basis, triangles
from calgraph.graph.graph_optimization import translations
from calgraph.graph.network_graph import average_network, covariances, joint_covariance, network_graph, trust
from calgraph.graph.network_initialization import Placed, placed
from calgraph.graph.pose_graph import Averaged, PoseGraph
from calgraph.graph.rotation_averaging import chained, irls_l1, l1mc, spectral
from calgraph.graph.spanning_tree import SpanningTree, grown, spanning_tree
from calgraph.graph.tree_consensus import consensus_trees

__all__ = [
    "Averaged",
    "Cycle",
    "Method",
    "Placed",
    "PoseGraph",
    "SpanningTree",
    "Start",
    "average",
    "average_network",
    "averaged_tree",
    "chained",
    "consensus_trees",
    "covariances",
    "cycle_basis",
    "grown",
    "irls_l1",
    "joint_covariance",
    "l1mc",
    "network_graph",
    "placed",
    "pose_graph",
    "spanning_tree",
    "spectral",
    "start_poses",
    "translations",
    "triangles",
    "trust",
]  # fmt: skip

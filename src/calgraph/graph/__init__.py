"""The graph of sensors: connectivity and start values."""

from calgraph.graph.averaging import (
    AveragingMethod,
    Initialization,
    average_poses,
    build_rig_graph,
    initialize_by_averaging,
    initialize_rig,
)
from calgraph.graph.cycles import Cycle, find_cycle_basis, find_triangles
from calgraph.graph.graph_optimization import solve_translations
from calgraph.graph.network_graph import (
    average_network,
    build_network_graph,
    compute_joint_covariance,
    compute_pose_covariances,
    edge_weights,
)
from calgraph.graph.network_initialization import NetworkInitialization, initialize_network
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.rotation_averaging import (
    average_rotations_irls,
    average_rotations_l1mc,
    average_rotations_spectral,
    chain_rotations,
)
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree, grow_tree
from calgraph.graph.tree_consensus import average_by_tree_consensus

__all__ = [
    "AveragingMethod",
    "Cycle",
    "Initialization",
    "NetworkInitialization",
    "PoseGraph",
    "PoseGraphSolution",
    "SpanningTree",
    "average_by_tree_consensus",
    "average_network",
    "average_poses",
    "average_rotations_irls",
    "average_rotations_l1mc",
    "average_rotations_spectral",
    "build_network_graph",
    "build_rig_graph",
    "chain_rotations",
    "compute_joint_covariance",
    "compute_pose_covariances",
    "edge_weights",
    "find_cycle_basis",
    "find_spanning_tree",
    "find_triangles",
    "grow_tree",
    "initialize_by_averaging",
    "initialize_network",
    "initialize_rig",
    "solve_translations",
]  # fmt: skip

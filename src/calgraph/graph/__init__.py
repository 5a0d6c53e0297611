"""The graph of sensors: connectivity and start values."""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.graph.ambiguous_parts import AmbiguousPart
    from calgraph.graph.clock_mounting_consensus import ClockMountingSolution, resolve_clocks_and_mountings
    from calgraph.graph.cycles import Cycle, find_cycle_basis
    from calgraph.graph.network_graph import (
        average_network,
        build_network_graph,
        compute_joint_covariance,
        edge_evidence,
        edge_weights,
        published_weights,
    )
    from calgraph.graph.network_initialization import NetworkInitialization, initialize_network
    from calgraph.graph.pose_graph import PoseAveraging, PoseGraph, PoseGraphSolution
    from calgraph.graph.rig_initialization import Initialization, build_rig_graph, initialize_rig
    from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree, grow_tree
    from calgraph.graph.tree_consensus import average_poses
else:
    __getattr__ = import_on_use(
        __name__,
        [
            "spanning_tree",
            "pose_graph",
            "rig_initialization",
            "tree_consensus",
            "cycles",
            "network_graph",
            "ambiguous_parts",
            "clock_mounting_consensus",
            "network_initialization",
        ],
    )

__all__ = [
    "AmbiguousPart", "ClockMountingSolution", "Cycle", "Initialization", "NetworkInitialization", "PoseAveraging",
    "PoseGraph", "PoseGraphSolution", "SpanningTree", "average_network", "average_poses", "build_network_graph",
    "build_rig_graph", "compute_joint_covariance", "edge_evidence", "edge_weights", "find_cycle_basis",
    "find_spanning_tree", "grow_tree", "initialize_network", "initialize_rig", "published_weights",
    "resolve_clocks_and_mountings",
]  # fmt: skip

"""The graph of sensors: connectivity and start values."""

from calgraph.graph.pose_graph import Averaged, PoseGraph
from calgraph.graph.tree import SpanningTree, spanning_tree, unconnected

__all__ = ["Averaged", "PoseGraph", "SpanningTree", "spanning_tree", "unconnected"]

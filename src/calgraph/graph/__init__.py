"""The graph of sensors: connectivity and start values."""

from calgraph.graph.tree import SpanningTree, spanning_tree, unconnected

__all__ = ["SpanningTree", "spanning_tree", "unconnected"]

"""Start poses of a rig's sensors from its pairwise estimates."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from calgraph.config.settings import BoardPairSettings
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.pose_graph import PoseAveraging, PoseGraph
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree, unobservable_stddev
from calgraph.graph.tree_consensus import average_poses

Initialization = Literal["tree", "identity", "consensus"] | PoseAveraging
"""Along the minimum spanning tree; all sensors at the root (which MSG-Cal, VII.A, compares); by consensus over
random trees; or by another averaging of all pairs."""


# m; standard deviation of the model error of a rig's pairs (bend of the board, range bias, stamps).
_RIG_TRANSLATION_FLOOR = 0.01
# rad (0.3°); the same of rotations: the above over a lever of 2 m.
_RIG_ROTATION_FLOOR = 0.005


def build_rig_graph(root: str, estimates: Sequence[PairwiseEstimate]) -> tuple[PoseGraph, tuple[str, ...]]:
    """A rig's pairs as a graph in space.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; several of one pair are alternatives.

    Returns:
        The graph of the sensors that are connected to the root, which is node 0; and their names in the order of
        nodes.
    """
    names = tuple(find_spanning_tree(root, estimates).T_root_sensor)
    node = {name: k for k, name in enumerate(names)}
    kept = [e for e in estimates if e.sensor_a in node]
    edges = np.array([(node[e.sensor_a], node[e.sensor_b]) for e in kept], dtype=np.intp).reshape(-1, 2)
    T = np.array([e.T_a_b for e in kept], dtype=np.float64).reshape(-1, 4, 4)
    information = np.array([e.information for e in kept], dtype=np.float64).reshape(-1, 6, 6)
    graph = PoseGraph(len(names), edges, T, information)
    return graph.with_error_floor(_RIG_TRANSLATION_FLOOR, _RIG_ROTATION_FLOOR), names


def initialize_rig(
    root: str,
    estimates: Sequence[PairwiseEstimate],
    start: Initialization,
    rng: np.random.Generator,
    max_stddev: float = BoardPairSettings().max_stddev,
) -> SpanningTree:
    """Start poses of the sensors that are connected to the root.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; at most one for each pair.
        start: the method.
        rng: used by ``consensus``.
        max_stddev: a pair does not observe directions of a larger standard deviation, m and rad.
    """
    tree = find_spanning_tree(root, estimates, max_stddev)
    if start == "tree":
        return tree
    if start == "identity":
        return replace(tree, T_root_sensor=dict.fromkeys(tree.T_root_sensor, np.eye(4)))
    # An averaging takes the arbitrary angle of a pair with an unobserved direction for measured, and a long lever
    # spreads that error to the other directions: such pairs serve only where no other pair reaches a sensor.
    usable = [
        e for e in estimates if unobservable_stddev(e, max_stddev) == 0 or tree.has_edge(e.sensor_a, e.sensor_b)
    ]
    graph, names = build_rig_graph(root, usable)
    solution = start(graph, None) if callable(start) else average_poses(graph, rng)
    connected = [e for e in usable if e.sensor_a in names]
    agreeing = [e for e, inlier in zip(connected, solution.inliers, strict=True) if inlier]
    inlier_tree = find_spanning_tree(root, agreeing, max_stddev)
    if len(inlier_tree.T_root_sensor) == len(names):
        tree = inlier_tree
    return replace(tree, T_root_sensor=dict(zip(names, solution.T_root_node, strict=True)))

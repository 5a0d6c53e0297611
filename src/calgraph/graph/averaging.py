"""From a graph of relative poses to poses of all nodes, by any of the methods; and the same for a rig's pairs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from calgraph.geometry import Array, se_n
from calgraph.graph.graph_optimization import solve_translations
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.rotation_averaging import (
    average_rotations_irls,
    average_rotations_l1mc,
    average_rotations_spectral,
    chain_rotations,
)
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree, unobservable_stddev
from calgraph.graph.tree_consensus import average_by_tree_consensus
from calgraph.pairwise import PairwiseEstimate
from calgraph.ransac import select_best_of_groups

AveragingMethod = Literal["consensus", "l1mc", "triangles", "spectral", "irls"]
Initialization = Literal["tree", "identity"] | AveragingMethod

# Edges agree with averaged rotations up to this angle, rad; others only hold together what nothing else does.
_AGREE = np.radians(5)
_HOLD = 1e-6
# What pairs of a rig are wrong by beyond their noise, m and rad: bend of the board, bias of ranges, stamps.
_POSITION_FLOOR, _ANGLE_FLOOR = 0.01, 0.005


def average_poses(
    graph: PoseGraph, rng: np.random.Generator, method: AveragingMethod = "consensus", weights: Array | None = None
) -> PoseGraphSolution:
    """Poses of all nodes from relative poses, some of them wrong.

    Args:
        graph: connected.
        rng: used by ``consensus``.
        method: ``consensus`` over spanning trees; or the published averaging of rotations ``l1mc`` over a basis
            of all cycles, over ``triangles`` alone, ``spectral``, or ``irls``, with least-squares translations
            over the edges whose rotations agree.
        weights: (E,) trust in each edge, 0..1; uniform without.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    if method == "consensus":
        return average_by_tree_consensus(graph, rng, weights)
    if method == "spectral":
        R = average_rotations_spectral(graph, weights)
    elif method == "irls":
        R = average_rotations_irls(graph, chain_rotations(graph), weights)
    else:
        R = average_rotations_l1mc(graph, weights, "cycles" if method == "l1mc" else "triangles")
    i, j = graph.edges.T
    off = se_n.rotation_angle(R[i] @ graph.R_i_j @ se_n.transpose(R[j])) / _AGREE
    agree = select_best_of_groups(off**2, graph.pair_of_edge)
    trust = np.where(agree, 1.0, _HOLD) * (1.0 if weights is None else weights)
    return PoseGraphSolution(se_n.pose(R, solve_translations(graph, R, trust)), agree)


def build_rig_graph(root: str, estimates: Sequence[PairwiseEstimate]) -> tuple[PoseGraph, tuple[str, ...]]:
    """A rig's pairs as a graph in space.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; several of one pair are alternatives.

    Returns:
        The graph of what is connected to the root, which is node 0; and the sensors' names in the order of nodes.
    """
    names = tuple(find_spanning_tree(root, estimates).T_root_sensor)
    node = {name: k for k, name in enumerate(names)}
    kept = [e for e in estimates if e.sensor_a in node]
    edges = np.array([(node[e.sensor_a], node[e.sensor_b]) for e in kept], dtype=np.intp).reshape(-1, 2)
    T = np.array([e.T_a_b for e in kept], dtype=np.float64).reshape(-1, 4, 4)
    information = np.array([e.information for e in kept], dtype=np.float64).reshape(-1, 6, 6)
    return PoseGraph(len(names), edges, T, information).with_error_floor(_POSITION_FLOOR, _ANGLE_FLOOR), names


def initialize_rig(
    root: str, estimates: Sequence[PairwiseEstimate], start: Initialization, rng: np.random.Generator
) -> SpanningTree:
    """Where a rig's joint solution starts.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; at most one for each pair.
        start: along the minimum spanning ``tree``; all sensors at the root (``identity``, which MSG-Cal, VII.A,
            compares); or all pairs averaged by one of the methods of :func:`average`.
        rng: used by ``consensus``.
    """
    if start == "tree":
        return find_spanning_tree(root, estimates)
    if start == "identity":
        tree = find_spanning_tree(root, estimates)
        return replace(tree, T_root_sensor=dict.fromkeys(tree.T_root_sensor, np.eye(4)))
    return initialize_by_averaging(root, estimates, rng, start)


def initialize_by_averaging(
    root: str,
    estimates: Sequence[PairwiseEstimate],
    rng: np.random.Generator,
    method: AveragingMethod = "consensus",
) -> SpanningTree:
    """Start poses of a rig from all its pairs at once, in place of those along its minimum spanning tree.

    Pairs that leave a direction open, as two 2-D scanners do, count only where no other pair reaches a sensor: an
    average of rotations takes their arbitrary angle for measured, and far from it their other directions err, too.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; at most one for each pair.
        rng: used by ``consensus``.
        method: as for :func:`average`.

    Returns:
        The minimum spanning tree of the pairs that agree, with averaged poses of all connected sensors.
    """
    every = find_spanning_tree(root, estimates)
    usable = [e for e in estimates if unobservable_stddev(e) == 0 or every.has_edge(e.sensor_a, e.sensor_b)]
    graph, names = build_rig_graph(root, usable)
    result = average_poses(graph, rng, method)
    kept = [e for e in usable if e.sensor_a in names]
    tree = find_spanning_tree(root, [e for e, agrees in zip(kept, result.inliers, strict=True) if agrees])
    if len(tree.T_root_sensor) < len(names):
        tree = every
    return replace(tree, T_root_sensor=dict(zip(names, result.T_root_node, strict=True)))

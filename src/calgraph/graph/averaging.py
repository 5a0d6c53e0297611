"""The averaging of pairs that an option chooses by name."""

from functools import partial
from typing import Literal

import numpy as np

from calgraph.config.settings import AveragingMethod
from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import PoseAveraging, PoseGraph, PoseGraphSolution
from calgraph.graph.rotation_averaging import (
    average_rotations_irls,
    average_rotations_l1mc,
    average_rotations_spectral,
    chain_rotations,
    solve_differences,
)
from calgraph.solver.ransac import select_best_of_groups


def select_averaging(method: AveragingMethod) -> PoseAveraging | None:
    """The averaging of pairs; None for the consensus. A published one is imported only where it is chosen."""
    if method == "consensus":
        return None

    return partial(average_poses_by_rotations, method=method)


RotationAveraging = Literal["l1mc", "triangles", "spectral", "irls"]

# Weight of an outlier edge, which keeps the graph connected.
_OUTLIER_WEIGHT = 1e-6


# rad (5°); edges that differ more from the averaged rotations are outliers: above the noise of pairs (0.2 to 2°),
# and small compared with the error of wrong ones.
_MAX_INLIER_ANGLE = float(np.radians(5))


def average_poses_by_rotations(
    graph: PoseGraph, weights: Array | None = None, method: RotationAveraging = "l1mc"
) -> PoseGraphSolution:
    """Poses of all nodes: rotations by a published averaging, translations over the edges whose rotations agree.

    Args:
        graph: connected.
        weights: (E,) of the edges, 0..1; uniform if None.
        method: ``l1mc`` over a basis of all cycles, or over ``triangles`` alone as published; ``spectral``;
            ``irls``.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    if method == "spectral":
        R = average_rotations_spectral(graph, weights)
    elif method == "irls":
        R = average_rotations_irls(graph, chain_rotations(graph), weights)
    else:
        R = average_rotations_l1mc(graph, weights, "cycles" if method == "l1mc" else "triangles")
    i, j = graph.edges.T
    angle = se_n.rotation_angle(R[i] @ graph.R_i_j @ se_n.transpose(R[j]))
    inliers = select_best_of_groups((angle / _MAX_INLIER_ANGLE) ** 2, graph.pair_of_edge)
    edge_weights = np.where(inliers, 1.0, _OUTLIER_WEIGHT) * (1.0 if weights is None else weights)
    return PoseGraphSolution(se_n.pose(R, solve_translations(graph, R, edge_weights)), inliers)


def solve_translations(graph: PoseGraph, rotations: Array, weights: Array | None = None) -> Array:
    """Positions (N, n) of least weighted squared error for fixed rotations, the root at the origin.

    Args:
        graph: connected by edges with weights.
        rotations: (N, n, n) from each node to the root.
        weights: (E,) of the edges; uniform if None.

    Raises:
        CalibrationError: some node is not connected to the root.
    """
    w = np.ones(len(graph.edges)) if weights is None else weights
    graph.select_edges(w > 0).require_connected()
    t = (rotations[graph.edges[:, 0]] @ se_n.translation(graph.T_i_j)[..., None])[..., 0]
    return solve_differences(graph, t, w)

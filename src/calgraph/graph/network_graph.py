"""A network's pairs, with all their alternatives, as a graph in the plane."""

from collections.abc import Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.graph.averaging import AveragingMethod, average_poses
from calgraph.graph.graph_optimization import optimize_poses
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution, chi_squared
from calgraph.pairwise import ScannerPairEstimate

# What pairs are wrong by beyond their noise: bodies are not ellipses, clocks not equal; m and rad.
_BEYOND_NOISE = (0.02, 0.004)
# How many residuals a prior is worth that takes this for right; scales tried, and how often the range is halved.
_PRIOR = 3.0
_SCALES = (0.05, 20.0)
_HALVINGS = 16
# Positions that agree (every 0.1 s), times their share of those that should, at which a pair is half trusted.
_DOUBTFUL = 50.0
# Such positions that matching walls are worth.
_WALLS = 100.0


def build_network_graph(root: str, pairs: Sequence[ScannerPairEstimate]) -> tuple[PoseGraph, tuple[str, ...]]:
    """The graph of what is connected to the root, which is node 0; and the scanners' names in the order of nodes.

    Every hypothesis of a pair is an edge: the graph as a whole decides which of them is right.
    """
    names = _connected_scanners(root, pairs)
    node = {name: k for k, name in enumerate(names)}
    kept = [(pair, h) for pair in pairs if pair.sensor_a in node for h in pair.hypotheses]
    edges = np.array([(node[p.sensor_a], node[p.sensor_b]) for p, _ in kept], dtype=np.intp).reshape(-1, 2)
    T = np.array([h.T_a_b for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    information = np.array([h.information for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    return PoseGraph(len(names), edges, T, information), names


def average_network(
    graph: PoseGraph, rng: np.random.Generator, method: AveragingMethod = "consensus", weights: Array | None = None
) -> tuple[PoseGraphSolution, PoseGraph]:
    """Poses of a network's scanners, as :func:`average` finds them, and the graph with errors as they are.

    What pairs are wrong by beyond their noise is not known of one pair alone. Those that agree show it when put
    together: by as much every pair is loosened, and the consensus' poses are adjusted once more.

    Args:
        graph: of :func:`network_graph`.
        rng: used by ``consensus``.
        method: as for :func:`average`.
        weights: (E,) trust in each edge; uniform without.
    """
    averaged = average_poses(graph.with_error_floor(*_BEYOND_NOISE), rng, method, weights)
    scale = _estimate_floor_scale(graph.select_edges(averaged.inliers), averaged.T_root_node)
    loosened = graph.with_error_floor(*(scale * floor for floor in _BEYOND_NOISE))
    if method != "consensus":
        return averaged, loosened
    T = optimize_poses(loosened, averaged.T_root_node, averaged.inliers.astype(np.float64))
    return PoseGraphSolution(T, averaged.inliers), loosened


def _estimate_floor_scale(right: PoseGraph, T_root_node: Array) -> float:
    """How many times what is usual the pairs' errors exceed their noise, where cycles tell; elsewhere once.

    The scale at which the squared residuals are as large as they should be, their number and a prior's together.
    """
    freedom = right.information.shape[-1] * (len(right.edges) - right.count + 1)
    low, high = _SCALES
    for _ in range(_HALVINGS):
        scale = float(np.sqrt(low * high))
        chi2 = float(
            chi_squared(right.with_error_floor(*(scale * floor for floor in _BEYOND_NOISE)), T_root_node).sum()
        )
        too_small = chi2 + _PRIOR / scale**2 > freedom + _PRIOR
        low, high = (scale, high) if too_small else (low, scale)
    return float(np.sqrt(low * high))


def edge_weights(names: Sequence[str], pairs: Sequence[ScannerPairEstimate]) -> Array:
    """Weights (E,) of the edges of :func:`network_graph`, 0..1: how likely each is right, by its own evidence.

    Wrong estimates come about where people who walked alike were taken for one. They last for seconds, and leave
    open why most of what both scanners saw does not agree. Quenzel et al. weigh likewise, after Schenk et al.,
    "Automatic calibration of a stationary network of laser range finders by matching movement trajectories",
    IROS 2012.

    Args:
        names: the scanners of the graph.
        pairs: as handed to :func:`network_graph`.
    """
    known = edge_evidence(names, pairs)
    return np.asarray(known / (known + _DOUBTFUL))


def edge_evidence(names: Sequence[str], pairs: Sequence[ScannerPairEstimate]) -> Array:
    """Evidence (E,) of the edges of :func:`network_graph`: what agrees, times its share of what should.

    Walls that match, too, are worth as much as many of these: of wrong poses hardly one brings them together.

    Args:
        names: the scanners of the graph.
        pairs: as handed to :func:`network_graph`.
    """
    kept = [h for p in pairs if p.sensor_a in names for h in p.hypotheses]
    return np.array([h.observations * h.matched_share + _WALLS * h.uses_background for h in kept])


def _connected_scanners(root: str, pairs: Sequence[ScannerPairEstimate]) -> tuple[str, ...]:
    reached = [root]
    for name in reached:
        for pair in pairs:
            for here, there in ((pair.sensor_a, pair.sensor_b), (pair.sensor_b, pair.sensor_a)):
                if here == name and there not in reached:
                    reached.append(there)
    return tuple(reached)


def compute_pose_covariances(graph: PoseGraph, T_root_node: Array) -> Array:
    """Covariances (N, 3, 3) of node poses: the blocks on the diagonal of :func:`joint_covariance`."""
    own = np.arange(graph.count)
    joint = compute_joint_covariance(graph, T_root_node).reshape(graph.count, 3, graph.count, 3)
    return np.asarray(joint[own, :, own])


def compute_joint_covariance(graph: PoseGraph, T_root_node: Array) -> Array:
    """Covariance (3N, 3N) of node poses in the root's fixed axes, from edges in the plane that are all right.

    Zero for the root. Directions that no edge fixes get a standard deviation of a kilometre or a thousand radians.
    """
    i, j = graph.edges.T
    R = T_root_node[i, :2, :2]
    B = np.zeros((len(i), 3, 3))
    B[:, :2, :2], B[:, 2, 2] = R, 1
    W = B @ graph.information @ np.swapaxes(B, -1, -2)
    arm = T_root_node[j, :2, 2] - T_root_node[i, :2, 2]
    J_i = np.tile(-np.eye(3), (len(i), 1, 1))
    J_i[:, :2, 2] -= np.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    WJ = W @ J_i
    blocks = ((i, i, np.swapaxes(J_i, -1, -2) @ WJ), (i, j, np.swapaxes(WJ, -1, -2)), (j, i, WJ), (j, j, W))
    H = np.zeros((graph.count, graph.count, 3, 3))
    for a, b, block in blocks:
        np.add.at(H, (a, b), block)
    flat = H.transpose(0, 2, 1, 3).reshape(3 * graph.count, -1) + 1e-6 * np.eye(3 * graph.count)
    free = np.repeat(np.arange(graph.count) != graph.root, 3)
    covariance = np.zeros_like(flat)
    covariance[np.ix_(free, free)] = np.linalg.inv(flat[np.ix_(free, free)])
    return covariance

"""A network's pairs, with all their alternatives, as a graph in the plane."""

from collections.abc import Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.graph.pose_graph import PoseGraph
from calgraph.pairwise import TrackPair

# What pairs are wrong by beyond their noise: bodies are not ellipses, clocks not equal; m and rad.
_BEYOND_NOISE = (0.02, 0.004)
# Truncated mean squared errors below this, in units of the gate, are alike.
_LEAST_COST = 0.01


def network_graph(root: str, pairs: Sequence[TrackPair]) -> tuple[PoseGraph, tuple[str, ...]]:
    """The graph of what is connected to the root, which is node 0; and the scanners' names in the order of nodes.

    Every hypothesis of a pair is an edge: the graph as a whole decides which of them is right.
    """
    names = _connected(root, pairs)
    node = {name: k for k, name in enumerate(names)}
    kept = [(pair, h) for pair in pairs if pair.sensor_a in node for h in pair.hypotheses]
    edges = np.array([(node[p.sensor_a], node[p.sensor_b]) for p, _ in kept], dtype=np.intp).reshape(-1, 2)
    T = np.array([h.T_a_b for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    information = np.array([h.information for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    return PoseGraph(len(names), edges, T, information).loosened(*_BEYOND_NOISE), names


def trust(names: Sequence[str], pairs: Sequence[TrackPair]) -> Array:
    """Weights (E,) of the edges of :func:`network_graph` for the published averagings; 1 on average.

    Matching positions count by their number and by how small the mean squared error of all simultaneous ones is,
    as in Schenk et al., "Automatic calibration of a stationary network of laser range finders by matching movement
    trajectories", IROS 2012.

    Args:
        names: the scanners of the graph.
        pairs: as handed to :func:`network_graph`.
    """
    kept = [h for pair in pairs if pair.sensor_a in names for h in pair.hypotheses]
    weights = np.array([h.observations / max(h.cost, _LEAST_COST) for h in kept])
    return np.asarray(weights / weights.mean()) if len(weights) else weights


def _connected(root: str, pairs: Sequence[TrackPair]) -> tuple[str, ...]:
    reached = [root]
    for name in reached:
        for pair in pairs:
            for here, there in ((pair.sensor_a, pair.sensor_b), (pair.sensor_b, pair.sensor_a)):
                if here == name and there not in reached:
                    reached.append(there)
    return tuple(reached)


def covariances(graph: PoseGraph, T_root_node: Array) -> Array:
    """Covariances (N, 3, 3) of node poses in the root's fixed axes, from edges in the plane that are all right.

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
    own = np.arange(graph.count)
    return np.asarray(covariance.reshape(graph.count, 3, graph.count, 3)[own, :, own])

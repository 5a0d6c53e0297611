"""A network's pairs, with all their alternatives, as a graph in the plane."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.sparse import eye_array

from calgraph.geometry import Array
from calgraph.graph.graph_optimization import build_normal_equations, optimize_poses
from calgraph.graph.pose_graph import PoseAveraging, PoseGraph, PoseGraphSolution, chi_squared
from calgraph.graph.tree_consensus import average_poses
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate

# Bisections of the scale of the floor, which give it to 0.01 %.
_BISECTIONS = 16
# Information added to make the covariance of unobservable directions finite: 1000 m or rad.
_MIN_INFORMATION = 1e-6


def build_network_graph(root: str, pairs: Sequence[ScannerPairEstimate]) -> tuple[PoseGraph, tuple[str, ...]]:
    """The graph of the scanners that are connected to the root, and their names in the order of nodes.

    The root is node 0. Every hypothesis of a pair is an edge: averaging selects at most one of them.
    """
    names = _connected_scanners(root, pairs)
    node = {name: k for k, name in enumerate(names)}
    kept = [(pair, h) for pair in pairs if pair.sensor_a in node for h in pair.hypotheses]
    edges = np.array([(node[p.sensor_a], node[p.sensor_b]) for p, _ in kept], dtype=np.intp).reshape(-1, 2)
    T = np.array([h.T_a_b for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    information = np.array([h.information for _, h in kept], dtype=np.float64).reshape(-1, 3, 3)
    return PoseGraph(len(names), edges, T, information), names


def average_network(
    graph: PoseGraph,
    rng: np.random.Generator,
    weights: Array | None = None,
    averaging: PoseAveraging | None = None,
) -> tuple[PoseGraphSolution, PoseGraph]:
    """Poses of a network's scanners by :func:`average_poses`, and the graph with the estimated error floor.

    The model error of pairs shows in the residuals of their cycles. The floor estimated from these is added to all
    edges, and the poses of the consensus are optimized once more.

    Args:
        graph: of :func:`build_network_graph`.
        rng: source of the random trees of the consensus.
        weights: (E,) of the edges, 0..1; uniform if None.
        averaging: in place of the consensus; its poses are taken as they are.
    """
    initial = _add_error_floor(graph, 1.0)
    solution = averaging(initial, weights) if averaging else average_poses(initial, rng, weights)
    scale = _estimate_floor_scale(graph.select_edges(solution.inliers), solution.T_root_node)
    inflated = _add_error_floor(graph, scale)
    if averaging:
        return solution, inflated
    T = optimize_poses(inflated, solution.T_root_node, solution.inliers.astype(np.float64))
    return PoseGraphSolution(T, solution.inliers), inflated


# m; initial model error of a network's pairs (bodies are not ellipses, clocks differ), scaled by the graph.
_NETWORK_TRANSLATION_FLOOR = 0.02
# rad (0.2°); the same of rotations: the above over the 5 m that a walk is long.
_NETWORK_ROTATION_FLOOR = 0.004


def _add_error_floor(graph: PoseGraph, scale: float) -> PoseGraph:
    return graph.with_error_floor(scale * _NETWORK_TRANSLATION_FLOOR, scale * _NETWORK_ROTATION_FLOOR)


# Minimum scale of these floors: 1 mm and 0.01°, which no pair reaches.
_MIN_FLOOR_SCALE = 0.05
# Maximum scale of these floors: 0.4 m and 5°, with which any pairs agree.
_MAX_FLOOR_SCALE = 20.0
# Weight of the prior that these floors are right, in residuals: those of one pair.
_FLOOR_PRIOR_WEIGHT = 3.0


def _estimate_floor_scale(inliers: PoseGraph, T_root_node: Array) -> float:
    """Scale of the error floor at which chi-squared equals the degrees of freedom, those of a prior included.

    The prior keeps the scale near 1 where the graph has few cycles.
    """
    degrees_of_freedom = inliers.information.shape[-1] * (len(inliers.edges) - inliers.count + 1)
    low, high = _MIN_FLOOR_SCALE, _MAX_FLOOR_SCALE
    for _ in range(_BISECTIONS):
        scale = float(np.sqrt(low * high))
        chi2 = float(chi_squared(_add_error_floor(inliers, scale), T_root_node).sum())
        too_small = chi2 + _FLOOR_PRIOR_WEIGHT / scale**2 > degrees_of_freedom + _FLOOR_PRIOR_WEIGHT
        low, high = (scale, high) if too_small else (low, scale)
    return float(np.sqrt(low * high))


# Positions as which matching walls count there: twice the above.
_WALL_POSITIONS = 100.0
# Agreeing positions, times their share, at which a published average gives a pair half the full weight: 5 s of
# one person.
_HALF_WEIGHT_POSITIONS = 50.0


def published_weights(names: Sequence[str], pairs: Sequence[ScannerPairEstimate]) -> Array:
    """Weights (E,) of the edges of :func:`build_network_graph`, 0..1, for the published averages.

    Agreeing positions times the share that agrees, as Quenzel et al. weight after Schenk et al., "Automatic
    calibration of a stationary network of laser range finders by matching movement trajectories", IROS 2012.
    Matching walls count as positions.

    Args:
        names: the scanners of the graph.
        pairs: as given to :func:`build_network_graph`.
    """
    hypotheses = list_hypotheses(names, pairs)
    agreeing = np.array([h.observations * h.matched_share for h in hypotheses])
    agreeing += [_WALL_POSITIONS * h.uses_background for h in hypotheses]
    return np.asarray(agreeing / (agreeing + _HALF_WEIGHT_POSITIONS))


# Weight of evidence at which an edge has half the full weight: a perfect fit of 5 s of one person, as long as
# people walk side by side; about that of the best wrong pairs in halls with a couple and no other people.
_HALF_WEIGHT_EVIDENCE = 130.0


def edge_weights(evidence: Array) -> Array:
    """Weights (E,), 0..1, of edges with evidence (E,): wrong pairs agree for seconds only, or coarsely."""
    return np.asarray(evidence / (evidence + _HALF_WEIGHT_EVIDENCE))


# Weight of evidence of matching walls: almost no wrong pose aligns them; twice the above.
_WALL_EVIDENCE = 260.0


def edge_evidence(names: Sequence[str], pairs: Sequence[ScannerPairEstimate]) -> Array:
    """Weight of evidence (E,) of the edges of :func:`build_network_graph`.

    Matching walls add a constant: hardly any wrong pose aligns them.

    Args:
        names: the scanners of the graph.
        pairs: as given to :func:`build_network_graph`.
    """
    return np.array(
        [h.weight_of_evidence() + _WALL_EVIDENCE * h.uses_background for h in list_hypotheses(names, pairs)]
    )


def list_hypotheses(names: Sequence[str], pairs: Sequence[ScannerPairEstimate]) -> list[PoseHypothesis]:
    """That of each edge of :func:`build_network_graph`."""
    connected = set(names)
    return [h for pair in pairs if pair.sensor_a in connected for h in pair.hypotheses]


def _connected_scanners(root: str, pairs: Sequence[ScannerPairEstimate]) -> tuple[str, ...]:
    """The root and all scanners that some chain of pairs connects to it, in breadth-first order."""
    neighbours: dict[str, list[str]] = {root: []}
    for pair in pairs:
        neighbours.setdefault(pair.sensor_a, []).append(pair.sensor_b)
        neighbours.setdefault(pair.sensor_b, []).append(pair.sensor_a)
    reached = {root: None}  # in order
    queue = deque([root])
    while queue:
        found = [end for end in dict.fromkeys(neighbours[queue.popleft()]) if end not in reached]
        reached.update(dict.fromkeys(found))
        queue.extend(found)
    return tuple(reached)


def compute_joint_covariance(graph: PoseGraph, T_root_node: Array) -> Array:
    """Covariance (3N, 3N) of node poses in the root's fixed axes, from edges in the plane that are all inliers.

    Zero for the root. Unobservable directions get a standard deviation of 1000 m or rad.
    """
    H, _ = build_normal_equations(graph, T_root_node, np.ones(len(graph.edges)))
    free = np.flatnonzero(np.repeat(np.arange(graph.count) != graph.root, 3))
    # Dense where it has to be only: that of a large network takes much memory.
    information = H[free][:, free] + _MIN_INFORMATION * eye_array(len(free))
    covariance = np.zeros(H.shape)
    covariance[np.ix_(free, free)] = np.linalg.inv(information.toarray())
    return covariance

"""The paper's joint estimator: sensors, planes and lines as nodes, six kinds of edges (MSG-Cal, section V)."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from calgraph.baselines import hypergraph_factors as edges
from calgraph.baselines.sparse_lm import Block, Factor, Values, marginal_covariance, minimize_sparse
from calgraph.detection import Detection, Segment, plane_of
from calgraph.estimation.rig.solution import RigSolution
from calgraph.geometry import Array, plane, se3
from calgraph.graph import SpanningTree
from calgraph.pairwise import Candidates, MatchFilter, PairwiseEstimate, select_matches

BLOCKS: Mapping[str, Block] = {
    "sensors": Block(6, se3.retract, fixed=(0,)),
    "planes": Block(3, plane.retract),
    "lines": Block(6, lambda lines, delta: lines + delta.reshape(-1, 2, 3)),
}

# How far a board that people carry is from a plane (m; and, over a metre, rad).
_FLATNESS = 0.001
# Directions that a pair knows no better than this (m and rad) are open: the joint solution leaves them where
# the spanning tree put them, as tightly as _HOLD.
_OPEN = 0.1
_HOLD = 0.01
# How firmly the stated noise is believed, in measured numbers.
_FIRM = 10
# What is believed of a pose without any data: m and rad.
_PRIOR = np.array([10.0, 10.0, 10.0, np.pi, np.pi, np.pi])


def solve_hypergraph(
    tree: SpanningTree,
    estimates: Sequence[PairwiseEstimate],
    detections: Mapping[str, Candidates],
    *,
    keep: MatchFilter = "ransac",
    optimize: bool = True,
) -> RigSolution:
    """Solves for all connected sensors at once.

    Args:
        tree: connected sensors with their start poses.
        estimates: pairwise estimates with their inliers.
        detections: by sensor and capture.
        keep: ``ransac`` uses the pairwise inliers only, ``none`` the first candidates of every common capture.
        optimize: False evaluates the start values, for comparison with them.

    Returns:
        Poses, covariances and residuals of the connected sensors.
    """
    names = list(tree.T_root_sensor)
    pairs = [e for e in estimates if e.sensor_a in names and e.sensor_b in names]
    if not pairs:
        return RigSolution(
            "hypergraph", {tree.root: np.eye(4)}, np.zeros((6, 6)), {}, converged=True, graph_error=0.0
        )
    graph = _HypergraphBuilder(names, detections)
    for pair in pairs:
        for capture, i, j in pair.matches[select_matches(pair, keep)]:
            graph.connect(pair, int(capture), int(i), int(j))
    values = graph.values(tree.T_root_sensor)
    observed = graph.observation_factors()
    factors: list[Factor] = [_relative_pose_factor(names, tree, pairs), *observed]
    converged = True
    if optimize:
        solution = minimize_sparse(values, BLOCKS, factors)
        values, converged = solution.state, solution.converged
    # The pairwise estimates come from the same detections: they may guide the solution, but not count as evidence.
    covariance = marginal_covariance(values, BLOCKS, observed, "sensors", _PRIOR)
    residuals = {factor.name: factor.linearize(values)[0] for factor in factors}
    chi2 = sum(float(np.sum(residuals[factor.name] ** 2)) for factor in observed)
    scatter = _variance_factor(chi2, graph.degrees_of_freedom - 6 * (len(names) - 1))
    return RigSolution(
        estimator="hypergraph",
        T_root_sensor={name: values["sensors"][i] for i, name in enumerate(names)},
        joint_covariance=covariance * scatter,
        residuals=residuals,
        converged=converged,
        graph_error=_graph_error(values, observed),
    )


class _HypergraphBuilder:
    """Collects the nodes and edges of the observations; a detection becomes a node when an edge needs it."""

    def __init__(self, names: Sequence[str], detections: Mapping[str, Candidates]) -> None:
        self._sensor = {name: i for i, name in enumerate(names)}
        self._detections = detections
        self._planes: dict[tuple[str, int, int], int] = {}
        self._lines: dict[tuple[str, int, int], int] = {}
        self._edges: dict[str, list[tuple[int, int, int, int]]] = {
            "plane-plane": [],
            "line-plane": [],
            "line-line": [],
        }

    def connect(self, pair: PairwiseEstimate, capture: int, i: int, j: int) -> None:
        """Adds the edge between detection i of the pair's sensor a and detection j of its sensor b."""
        ends = sorted(
            (self._node(name, capture, k) for name, k in ((pair.sensor_a, i), (pair.sensor_b, j))),
            key=lambda end: end[0],
        )
        (kind_a, *a), (kind_b, *b) = ends
        self._edges[f"{kind_a}-{kind_b}"].append((a[0], a[1], b[0], b[1]))

    def _node(self, sensor: str, capture: int, k: int) -> tuple[str, int, int]:
        detection = self._detections[sensor][capture][k]
        kind, nodes = ("line", self._lines) if isinstance(detection, Segment) else ("plane", self._planes)
        return kind, self._sensor[sensor], nodes.setdefault((sensor, capture, k), len(nodes))

    def _of(self, nodes: Mapping[tuple[str, int, int], int]) -> Iterator[Detection]:
        return (self._detections[sensor][capture][k] for sensor, capture, k in nodes)

    def values(self, T_root_sensor: Mapping[str, Array]) -> Values:
        """Start values: poses as given, observations as measured."""
        planes = [plane_of(d)[0] for d in self._of(self._planes) if not isinstance(d, Segment)]
        lines = [d.endpoints for d in self._of(self._lines) if isinstance(d, Segment)]
        return {
            "sensors": np.array([T_root_sensor[name] for name in self._sensor]),
            "planes": np.array(planes).reshape(-1, 4),
            "lines": np.array(lines).reshape(-1, 2, 3),
        }

    @property
    def degrees_of_freedom(self) -> int:
        """How many numbers the detections measure beyond the three that place each capture's board."""
        measured: Counter[int] = Counter()
        for nodes, numbers in ((self._planes, 3), (self._lines, 2)):
            for _, capture, _ in nodes:
                measured[capture] += numbers
        return sum(numbers - 3 for numbers in measured.values())

    def observation_factors(self) -> list[Factor]:
        """All edges but sensor–sensor."""
        planes = [plane_of(d) for d in self._of(self._planes) if not isinstance(d, Segment)]
        lines = [(d.endpoints, d.covariance) for d in self._of(self._lines) if isinstance(d, Segment)]
        factors: list[Factor] = []
        if planes:
            measured, covariance = (np.array(part) for part in zip(*planes, strict=True))
            factors.append(edges.SensorPlane(np.arange(len(planes)), measured, edges.whitener(covariance)))
        if lines:
            measured, covariance = (np.array(part) for part in zip(*lines, strict=True))
            factors.append(edges.SensorLine(np.arange(len(lines)), measured, edges.whitener(covariance)))
        for name, build in _OBSERVATION_FACTORS.items():
            if self._edges[name]:
                factors.append(build(*np.array(self._edges[name], dtype=np.intp).T, _FLATNESS))
        return factors


_OBSERVATION_FACTORS: Mapping[str, Callable[..., Factor]] = {
    "plane-plane": edges.PlanePlane,
    "line-plane": edges.LinePlane,
    "line-line": edges.LineLine,
}


def _relative_pose_factor(names: Sequence[str], tree: SpanningTree, pairs: Sequence[PairwiseEstimate]) -> Factor:
    """Sensor–sensor edges (eq. 6).

    Their inliers are in the graph as observations already, so each edge weighs as one capture. What a pair of the
    tree leaves open is held. Other pairs with an open direction are no edges: along it they may be turned by any
    angle, and that far away their other directions are not those measured.
    """
    pairs = [p for p in pairs if tree.has_edge(p.sensor_a, p.sensor_b) or not _has_open_direction(p)]
    whiteners = []
    for pair in pairs:
        eigenvalues, vectors = np.linalg.eigh(pair.information)
        weights = np.maximum(eigenvalues, 0) / max(int(pair.inliers.sum()), 1)
        if tree.has_edge(pair.sensor_a, pair.sensor_b):
            weights = np.where(eigenvalues < _OPEN**-2, _HOLD**-2, weights)
        whiteners.append(np.sqrt(weights)[:, None] * vectors.T)
    return edges.SensorSensor(
        np.array([names.index(p.sensor_a) for p in pairs], dtype=np.intp),
        np.array([names.index(p.sensor_b) for p in pairs], dtype=np.intp),
        np.array([p.T_a_b for p in pairs]),
        np.array(whiteners),
    )


def _has_open_direction(pair: PairwiseEstimate) -> bool:
    return bool(np.linalg.eigvalsh(pair.information)[0] < _OPEN**-2)


def _variance_factor(chi2: float, freedom: int) -> float:
    """Variance factor: how the residuals' scatter compares with what the covariances state.

    Few captures say little of it: it then stays near 1, as if that had been measured _FIRM times before.
    """
    return (chi2 + _FIRM) / (max(freedom, 0) + _FIRM)


def _graph_error(values: Values, observed: Sequence[Factor]) -> float:
    """Sum of squared errors, m²: observation edges undo their whitening, measurements compare as they are."""
    total = 0.0
    for factor in observed:
        if isinstance(factor, edges.SensorPlane):
            e = values["planes"][factor.plane] - factor.measured
        elif isinstance(factor, edges.SensorLine):
            e = values["lines"][factor.line] - factor.measured
        else:
            e = factor.linearize(values)[0] * _FLATNESS
        total += float(np.sum(e**2))
    return total

"""The paper's joint estimator: sensors, planes and lines as nodes, six kinds of edges (MSG-Cal, section V)."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.detections import Segment, plane_of
from calgraph.config.settings import MatchFilter, Settings
from calgraph.geometry import Array, plane, se3
from calgraph.graph.pairwise_estimate import FLATNESS, PairwiseEstimate, select_matches
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.bundle.variance_components import STATED_NOISE_WEIGHT
from calgraph.rig.pairs.board_matches import Candidates
from calgraph.rig.published import hypergraph_factors as factor_types
from calgraph.rig.published.sparse_lm import Block, Factor, Values, marginal_covariance, minimize_sparse

BLOCKS: Mapping[str, Block] = {
    "sensors": Block(6, se3.retract, fixed=(0,)),
    "planes": Block(3, plane.retract),
    "lines": Block(6, lambda lines, delta: lines + delta.reshape(-1, 2, 3)),
}


@dataclass(frozen=True, eq=False)
class HypergraphSolution(RigSolution):
    """The joint solution of a rig's connected sensors, with residuals by kind of edge."""

    graph_error: float = 0.0
    """Sum of squared errors over all edges but sensor–sensor, m² (MSG-Cal, VII.A)."""


# m and rad; the hypergraph holds a direction that a pair of the tree does not observe with this standard
# deviation at its start value: small compared with the limit of an observed direction
# (`pairwise.board.max_stddev`).
_HELD_STDDEV = 0.01
# Limit on steps of the hypergraph's solution, which states whether it converged: the tests of this estimator need
# up to 46, where poses start far from the solution.
_MAX_STEPS = 50
# m; standard deviation that the hypergraph states for unobservable positions: the size of a scene.
_PRIOR_TRANSLATION_STDDEV = 10.0
# rad; the same for unobservable rotations: any angle.
_PRIOR_ROTATION_STDDEV = float(np.pi)


def solve_hypergraph(
    tree: SpanningTree,
    estimates: Sequence[PairwiseEstimate],
    detections: Mapping[str, Candidates],
    *,
    keep: MatchFilter = "ransac",
    optimize: bool = True,
    settings: Settings,
) -> HypergraphSolution:
    """Solves for the poses of all connected sensors jointly.

    Args:
        tree: connected sensors with their start poses.
        estimates: pairwise estimates with their inliers.
        detections: by sensor and capture.
        keep: ``ransac`` uses the pairwise inliers only, ``none`` the first candidates of every common capture.
        optimize: False evaluates the start values, for comparison with them.
        settings: of the baselines; and the flatness of boards, the limit of observed directions and the weight of
            the stated noise, which other stages use, too.

    Returns:
        Poses, covariances and residuals of the connected sensors.
    """
    names = list(tree.T_root_sensor)
    pairs = [e for e in estimates if e.sensor_a in names and e.sensor_b in names]
    if not pairs:
        return HypergraphSolution("hypergraph", {tree.root: np.eye(4)}, np.zeros((6, 6)), {}, converged=True)
    graph = _HypergraphBuilder(names, detections)
    for pair in pairs:
        for capture, i, j in pair.matches[select_matches(pair, keep)]:
            graph.connect(pair, int(capture), int(i), int(j))
    values = graph.values(tree.T_root_sensor)
    observed = graph.observation_factors()
    max_stddev = settings.pairwise.board.max_stddev
    factors: list[Factor] = [_relative_pose_factor(names, tree, pairs, max_stddev), *observed]
    converged = True
    if optimize:
        solution = minimize_sparse(values, BLOCKS, factors, iterations=_MAX_STEPS)
        values, converged = solution.state, solution.converged
    # Pairwise estimates come from the same detections: they are no independent information for the covariance.
    prior = np.repeat([_PRIOR_TRANSLATION_STDDEV, _PRIOR_ROTATION_STDDEV], 3)
    covariance = marginal_covariance(values, BLOCKS, observed, "sensors", prior)
    residuals = {factor.name: factor.linearize(values)[0] for factor in factors}
    chi2 = sum(float(np.sum(residuals[factor.name] ** 2)) for factor in observed)
    dof = max(graph.degrees_of_freedom - 6 * (len(names) - 1), 0)
    weight = STATED_NOISE_WEIGHT
    return HypergraphSolution(
        estimator="hypergraph",
        T_root_sensor={name: values["sensors"][i] for i, name in enumerate(names)},
        joint_covariance=covariance * (chi2 + weight) / (dof + weight),
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

    def _measure(self) -> tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]:
        """Planes (4,) with covariances (3, 3), and end points of lines (2, 3) with covariances (6, 6)."""
        found = [self._detections[sensor][capture][k] for sensor, capture, k in (*self._planes, *self._lines)]
        lines = [(one.endpoints, one.covariance) for one in found if isinstance(one, Segment)]
        return [plane_of(one) for one in found if not isinstance(one, Segment)], lines

    def values(self, T_root_sensor: Mapping[str, Array]) -> Values:
        """Start values: poses as given, observations as measured."""
        planes, lines = self._measure()
        return {
            "sensors": np.array([T_root_sensor[name] for name in self._sensor]),
            "planes": np.array([measured for measured, _ in planes]).reshape(-1, 4),
            "lines": np.array([measured for measured, _ in lines]).reshape(-1, 2, 3),
        }

    @property
    def degrees_of_freedom(self) -> int:
        """Number of measured quantities beyond the three that locate the board of each capture."""
        measured: Counter[int] = Counter()
        for nodes, numbers in ((self._planes, 3), (self._lines, 2)):
            for _, capture, _ in nodes:
                measured[capture] += numbers
        return sum(numbers - 3 for numbers in measured.values())

    def observation_factors(self) -> list[Factor]:
        """All edges but sensor–sensor."""
        factors: list[Factor] = []
        kinds: tuple[Callable[..., Factor], ...] = factor_types.SensorPlane, factor_types.SensorLine
        for found, build in zip(self._measure(), kinds, strict=True):
            if found:
                measured, covariance = (np.array(part) for part in zip(*found, strict=True))
                factors.append(build(np.arange(len(found)), measured, factor_types.whitener(covariance)))
        for name, build in _OBSERVATION_FACTORS.items():
            if self._edges[name]:
                factors.append(build(*np.array(self._edges[name], dtype=np.intp).T, FLATNESS))
        return factors


_OBSERVATION_FACTORS: Mapping[str, Callable[..., Factor]] = {
    "plane-plane": factor_types.PlanePlane,
    "line-plane": factor_types.LinePlane,
    "line-line": factor_types.LineLine,
}


def _relative_pose_factor(
    names: Sequence[str], tree: SpanningTree, pairs: Sequence[PairwiseEstimate], max_stddev: float
) -> Factor:
    """Sensor–sensor edges (eq. 6).

    Their inliers are observations of the graph, too: each edge has the weight of one capture. Directions that a
    pair of the tree does not observe are held at their start value. Other pairs with an unobserved direction are
    not used: they may be rotated by any angle about it, where their linearization along the others is not valid.
    """
    pairs = [
        pair
        for pair in pairs
        if tree.has_edge(pair.sensor_a, pair.sensor_b) or np.linalg.eigvalsh(pair.information)[0] >= max_stddev**-2
    ]
    whiteners = []
    for pair in pairs:
        eigenvalues, vectors = np.linalg.eigh(pair.information)
        weights = np.maximum(eigenvalues, 0) / max(int(pair.inliers.sum()), 1)
        if tree.has_edge(pair.sensor_a, pair.sensor_b):
            weights = np.where(eigenvalues < max_stddev**-2, _HELD_STDDEV**-2, weights)
        whiteners.append(np.sqrt(weights)[:, None] * vectors.T)
    return factor_types.SensorSensor(
        np.array([names.index(p.sensor_a) for p in pairs], dtype=np.intp),
        np.array([names.index(p.sensor_b) for p in pairs], dtype=np.intp),
        np.array([p.T_a_b for p in pairs]),
        np.array(whiteners),
    )


def _graph_error(values: Values, observed: Sequence[Factor]) -> float:
    """Sum of squared errors, m²: of observation edges without their whitening, of measurements as they are."""
    total = 0.0
    for factor in observed:
        if isinstance(factor, factor_types.SensorPlane):
            e = values["planes"][factor.plane] - factor.measured
        elif isinstance(factor, factor_types.SensorLine):
            e = values["lines"][factor.line] - factor.measured
        else:
            e = factor.linearize(values)[0] * FLATNESS
        total += float(np.sum(e**2))
    return total

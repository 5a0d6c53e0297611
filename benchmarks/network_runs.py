"""Simulated recordings of networks, and the ways to calibrate them that tables compare."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, Lidar2dSpec, People, Rig
from calgraph.config.settings import CenterFeature, NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import Array, se2
from calgraph.graph.averaging import select_averaging
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.random_trees import compute_tree_poses
from calgraph.network.graph.network_graph import (
    average_network,
    build_network_graph,
    compute_joint_covariance,
    published_weights,
)
from calgraph.network.graph.network_initialization import initialize_network
from calgraph.network.joint.estimate import solve_network
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.pairs.synchronized_tracks import pair_samples, resample_tracks
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.scanner_pairs import DEPTH_STDDEV_OF
from calgraph.network.track_recording import select_center_estimator
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    GroundTruth,
    NetworkScenario,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)

SCENARIOS: Mapping[str, dict[str, Any]] = {
    "ring": {"layout": "ring", "ring_diameter": 46.0, "duration": 180.0},
    "ring60": {"layout": "ring", "duration": 180.0},
    "semicircle": {"layout": "semicircle"},
    "office": {"layout": "office"},
    "lab": {"layout": "lab"},
    "halls": {"layout": "halls"},
}
CYLINDER = ("ring", "ring60")
FEATURES: tuple[CenterFeature, ...] = ("com", "ellipse", "nls")
USUAL_PEOPLE = 2
GROSS = (5.0, 0.5)
"""Degrees and metres."""

Average = Literal["consensus", "l1mc", "triangles", "spectral", "irls", "none"]


Condition = Literal["as is", "clocks", "radii", "arms"]
CONDITIONS: Mapping[str, tuple[Condition, ...]] = {
    "ring": ("as is", "clocks", "radii"),
    **dict.fromkeys(("office", "lab", "halls"), get_args(Condition)),
}
"""Of Table 5, by scenario: a cylinder has no arms."""
CLOCKS, ARMS, SIZES = 0.05, 0.15, (1.3, 0.7)
"""Largest clock offset, s; amplitude of arms, m; true radii over those stated, for even and odd seeds."""


class Cell(NamedTuple):
    """One kind of recording."""

    scenario: str
    people: int
    condition: Condition = "as is"


class Setup(NamedTuple):
    """A method of calibration."""

    feature: CenterFeature
    icp: bool
    average: Average
    weighted: bool
    joint: bool = False


PUBLISHED = Setup("com", True, "l1mc", False)
AVERAGING = Setup("nls", True, "consensus", True)
JOINT = AVERAGING._replace(joint=True)
OURS = {"averaging": AVERAGING, "joint": JOINT}


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of one setup."""

    names: tuple[str, ...]
    """Scanners that are connected, the root first."""
    T_root_scanner: Array
    """(N, 3, 3)."""
    covariance: Array
    """(3N, 3N) of the poses."""
    offset: Array
    """(N,) scanner clock minus root clock, s; NaN where it was not estimated."""


@dataclass(frozen=True, eq=False)
class Run:
    """Errors of one recording."""

    errors: Mapping[Setup, Array]
    """(S, 2) degrees and metres of each scanner but the root; NaN where there is no pose."""
    nees: Mapping[Setup, Array]
    """(S,) squared errors over their covariances, per degree of freedom, of what has a pose."""
    clocks: Array
    """(S,) errors of the clock offsets that the joint solution has, s."""
    pairs: Array
    """(P, 2) of the published pairs: whether right, and the RMS distance of simultaneous positions, m."""


def list_cells(scenario: str, people: Sequence[int]) -> list[Cell]:
    """The recordings of a scenario: office and lab with any number of people, the usual one in all conditions."""
    if scenario in CYLINDER:
        counts: Sequence[int] = (1,)
    else:
        counts = people if scenario in ("office", "lab") else (1, USUAL_PEOPLE)
    cells = [Cell(scenario, count) for count in counts]
    others = [name for name in CONDITIONS.get(scenario, ()) if name != "as is"]
    return cells + [cell._replace(condition=name) for cell in cells if is_usual(cell) for name in others]


def is_usual(cell: Cell) -> bool:
    """Whether the number of people is the usual one of this scenario."""
    return cell.people == USUAL_PEOPLE or cell.scenario in CYLINDER


def run(cell: Cell, seed: int, setups: Sequence[Setup]) -> Run:
    """Simulates one recording and calibrates it with all setups, each stage once."""
    network = build_network(build_scenario(cell), seed)
    rig, truth = apply_condition(network_rig(network), cell, seed), project_poses(network_truth(network))
    scans = {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}
    results: dict[Setup, Solved] = {}
    judged = np.zeros((0, 2))
    for feature in sorted({setup.feature for setup in setups}):
        tracked = track_scanners(rig, scans, feature)
        for icp in sorted({setup.icp for setup in setups if setup.feature == feature}):
            rng = np.random.default_rng(seed)
            estimates = estimate_scanner_pairs(tracked, rng, icp=icp, depth_stddev=DEPTH_STDDEV_OF[feature])
            pairs = [pair for pair in estimates.values() if isinstance(pair, ScannerPairEstimate)]
            if feature == "com" and icp:
                judged = np.array([judge(pair, tracked, truth) for pair in pairs]).reshape(-1, 2)
            for setup in (s for s in setups if (s.feature, s.icp) == (feature, icp)):
                results[setup] = solve_poses(rig, tracked, pairs, setup, rng)
    off = {scanner.name: scanner.clock_offset for scanner in network.scanners}
    joint = results.get(JOINT)
    return Run(
        {setup: compute_errors(one, truth) for setup, one in results.items()},
        {setup: compute_nees(one, truth) for setup, one in results.items()},
        joint.offset[1:] - [off[name] for name in joint.names[1:]] if joint else np.zeros(0),
        judged,
    )


def build_scenario(cell: Cell) -> NetworkScenario:
    """The scenario of a recording."""
    parameters: dict[str, Any] = {**SCENARIOS[cell.scenario], "people": {"count": cell.people}}
    if cell.condition == "clocks":
        parameters["scanner"] = {"clock_offset": CLOCKS}
    if cell.condition == "arms":
        parameters["people"]["swing"] = ARMS
    return NetworkScenario(**parameters)


def apply_condition(rig: Rig, cell: Cell, seed: int) -> Rig:
    """The rig with the stated radii of its bodies."""
    if cell.condition != "radii":
        return rig
    target, off = rig.target, SIZES[seed % 2]
    assert isinstance(target, People | Cylinder)
    across, along = target.axes if isinstance(target, People) else (target.diameter / 2, target.diameter / 2)
    return rig.model_copy(update={"target": People(kind="people", axes=(across / off, along / off))})


def track_scanners(
    rig: Rig, scans: Mapping[str, list[LaserScan]], feature: CenterFeature
) -> dict[str, ScannerTracks]:
    """The tracks of each scanner that has any."""
    assert isinstance(rig.target, People | Cylinder)
    tracked: dict[str, ScannerTracks] = {}
    for name, spec in rig.sensors.items():
        assert isinstance(spec, Lidar2dSpec)
        found = track_scanner(
            scans[name],
            rig.target,
            spec.noise,
            centers=select_center_estimator(feature),
            settings=TrackingSettings(),
        )
        if isinstance(found, ScannerTracks):
            tracked[name] = found
    return tracked


def project_poses(truth: GroundTruth) -> dict[str, Array]:
    """T_root_sensor (3, 3) by sensor."""
    in_plane = np.ix_((0, 1, 3), (0, 1, 3))
    return {name: T[in_plane] for name, T in truth.T_root_sensor.items()}


def solve_poses(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    pairs: Sequence[ScannerPairEstimate],
    setup: Setup,
    rng: np.random.Generator,
) -> Solved:
    """Poses of the connected scanners; the published method has one estimate per pair, and rejects none."""
    if setup.average == "consensus":
        sights = {name: ScannerObservations.from_tracks(tracks) for name, tracks in tracked.items()}
        ends = {(pair.sensor_a, pair.sensor_b): pair for pair in pairs}
        sure = initialize_network(rig.root, ends, sights, rng, weighted=setup.weighted)
        graph, names, averaged = sure.graph, sure.names, sure.solution
    else:
        pairs = [replace(pair, hypotheses=pair.hypotheses[:1]) for pair in pairs]
        graph, names = build_network_graph(rig.root, pairs)
        if setup.average == "none":
            averaged = chain_pairs(graph, pairs, names)
        else:
            weights = published_weights(names, pairs) if setup.weighted else None
            averaged, graph = average_network(graph, rng, weights, select_averaging(setup.average))
    if not setup.joint:
        spread = compute_joint_covariance(graph.select_edges(averaged.inliers), averaged.T_root_node)
        return Solved(names, averaged.T_root_node, spread, np.full(len(names), np.nan))
    assert isinstance(rig.target, People | Cylinder)
    joint = solve_network(
        rig.target, [tracked[name] for name in names], averaged, graph, settings=NetworkEstimationSettings()
    )
    return Solved(names, joint.T_root_scanner, joint.pose_covariance, joint.clock_offset)


def chain_pairs(graph: PoseGraph, pairs: Sequence[ScannerPairEstimate], names: Sequence[str]) -> PoseGraphSolution:
    """The pair with the root where there is one, otherwise the fewest and best pairs."""
    costs = np.array([1 + pair.hypotheses[0].cost for pair in pairs if pair.sensor_a in names])
    return PoseGraphSolution(compute_tree_poses(graph, costs[None])[0], np.ones(len(costs), dtype=np.bool_))


def compute_errors(solved: Solved, truth: Mapping[str, Array]) -> Array:
    """(S, 2) degrees and metres of all scanners but the root, NaN without a pose."""
    found = dict(zip(solved.names, solved.T_root_scanner, strict=True))
    nowhere = np.full((3, 3), np.nan)
    others = [name for name in truth if name != solved.names[0]]
    off = np.array([se2.difference(found.get(name, nowhere), truth[name]) for name in others])
    return np.column_stack([np.degrees(np.abs(off[:, 2])), np.hypot(off[:, 0], off[:, 1])])


def compute_nees(solved: Solved, truth: Mapping[str, Array]) -> Array:
    """(S,) normalised estimation errors squared per degree of freedom of all scanners found but the root."""
    off = se2.difference(solved.T_root_scanner, np.array([truth[name] for name in solved.names]))
    blocks = [solved.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(off))]
    return np.array([e @ np.linalg.solve(C, e) / 3 for e, C in zip(off[1:], blocks[1:], strict=True)])


def judge(
    pair: ScannerPairEstimate, tracked: Mapping[str, ScannerTracks], truth: Mapping[str, Array]
) -> tuple[bool, float]:
    """Whether a pair is right, and the RMS distance of simultaneous positions of both scanners, m."""
    true = se2.inverse(truth[pair.sensor_a]) @ truth[pair.sensor_b]
    off = se2.difference(pair.T_a_b, true)
    right = np.degrees(abs(off[2])) < GROSS[0] and np.hypot(off[0], off[1]) < GROSS[1]
    simultaneous = pair_samples(resample_tracks(tracked[pair.sensor_a]), resample_tracks(tracked[pair.sensor_b]))
    squared = np.sum((se2.apply(pair.T_a_b, simultaneous.x_b) - simultaneous.x_a) ** 2, axis=1)
    return bool(right), float(np.sqrt(np.mean(np.minimum.reduceat(squared, simultaneous.run_starts_a))))


def find_gross_errors(errors: Array) -> NDArray[np.bool_]:
    """(S,) whether errors (S, 2) are grossly wrong or missing."""
    return np.asarray(~(errors < np.array(GROSS)).all(axis=1))

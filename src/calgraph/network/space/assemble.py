"""Assembles the Calibration of a network in space: poses with verdicts, and what contradicts them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2, se3
from calgraph.network.checks.assemble import (
    build_edge,
    build_floor_views,
    build_walk_rows,
    explain_unconnected,
    find_parents,
    match_across_scanners,
)
from calgraph.network.joint.planar_poses import NetworkPoses
from calgraph.network.pairs.synchronized_tracks import TrackSamples, resample_tracks
from calgraph.network.space.joint import SpaceSolution, condition_on
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.persons import LEVELLING
from calgraph.network.space.roots import spread_floor
from calgraph.network.space.start import SpaceStart
from calgraph.network.space.static_surfaces import count_level_cells, thin_points
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.result import (
    Calibration,
    EstimatedParameter,
    Evidence,
    FitError,
    FloorView,
    Pictures,
    SensorPose,
    Verdict,
)
from calgraph.result.finding import Finding
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.solver.connected_parts import label_parts
from calgraph.surfaces.sensor_states import BESIDE_POSE, DRIFT, SensorState, expand_covariance, number_free
from calgraph.verdict.grades import LONE_ROOT, collect_findings, grade_pose, max_good_stddev

_ADVICE = "let people walk farther and in more directions between {} and {}"
_RANGE_ADVICE = (
    "measure the range errors of the sensors at known distances, and state what is left in rig.yaml "
    "(uncertainty: range_scale, range_bias)"
)
_LEVEL_ADVICE = (
    "the walls and people that {} measures do not show its height, roll and pitch: measure these, and "
    "state them in rig.yaml (height, roll, pitch, and uncertainty: tilt)"
)
_ROOT_ADVICE = ", or let a 3-D LiDAR be the root"
_WALK_IN = "let people walk from its view into those of its neighbours, with turns"
_FLOOR_ADVICE = (
    "let more of the floor be in the view of {}, and state the biases of its ranges (uncertainty: range_bias, "
    "ring_bias)"
)
# Sources of uncertainty, of which the largest in the most uncertain axis is what to improve. That of height and
# tilt of a 2-D scanner is what is stated.
_RANGES, _FLOOR, _REST, _STATED = "range errors", "the floor", "walks and surfaces", "stated height and tilt"
_OF_ROOT = f"{_STATED} of the root"
# Squared last step of the joint solution, in standard deviations, up to which it has converged.
_MAX_SQUARED_STEP = 0.1
# Walls on which two maps agree, less the others, and that over both, below which nothing but people shows that a
# pose is right. In simulated halls with 16 and 32 rings right pairs have 20 to 83, and 0.87 to 1.0; wrong ones are
# at most 0.54 if they are 0.2 to 3 m or 1 to 20 degrees off, and 0.4 after half a turn, which maps walls of a hall
# onto each other. Numbers do not distinguish these: they are up to 31.
_MIN_AGREEMENT, _MIN_BALANCE = 4.0, 0.6
# Cells of floor, of 1 m, that two LiDARs have to measure for their heights to be compared: three places determine
# a plane. With fewer, heights rest on how walls lean: of seven halls of two LiDARs of 16 rings, the four with up
# to two cells have errors of 53 to 294 mm, 1.8 to 4 standard deviations, the others of 28 to 104 mm, up to 2.3.
_MIN_LEVEL_CELLS = 3
# Axes of a level scanner along and about which it does not measure.
_LEVEL_AXES = (2, 3, 4)
# Static points of a sensor that are kept for pictures: walls of a hall are about 0.3 m between points.
_MAX_POINTS = 4000


@dataclass(frozen=True, eq=False)
class SpaceResult:
    """What is known of a network."""

    observed: Mapping[str, SpaceObservations | Rejected]
    frames: Mapping[str, str]
    """That messages state."""
    start: SpaceStart
    begin: float
    """Of the recording, s."""
    solution: SpaceSolution | None
    """Of the sensors with a start, in its order; None if nothing is connected to the root."""
    findings: Sequence[Finding]


def assemble_space(rig: Rig, result: SpaceResult) -> Calibration:
    """The calibration of a network in space, in the frame of its first sensor; that of the root if it is alone.

    Grades and clocks are relative to the root of the rig.
    """
    solution, start, root = result.solution, result.start, rig.reference
    names = list(start.states) if solution else [root]
    at = names.index(root)
    states = solution.states if solution else [_start_alone(start.observed.get(root))]
    located = NetworkPoses((root,), np.eye(4)[None], np.zeros((6, 6)))
    verdicts, clocks = {root: LONE_ROOT}, np.zeros((1, 2))
    if solution:
        located = locate_sensors(names, solution)
        verdicts = _grade_poses(rig, names, solution, result.observed, result.findings)
        clocks = _relate_to(solution, at, -BESIDE_POSE, [one.clock_offset for one in states])
        sweep = np.array([start.observed[name].untimed_sweep for name in names])
        # Stamps without times of points are of the begin or the end of a sweep, and people anywhere in it: their
        # times are equally likely from a sweep before the stamp to a sweep after it.
        clocks[:, 1] = np.sqrt(clocks[:, 1] ** 2 + (sweep**2 + sweep[at] ** 2) / 3)
    initial = start.initialization
    inliers = initial.graph.select_edges(initial.solution.inliers)
    parents = find_parents(inliers, initial.names)
    sensors = []
    for k, name in enumerate(names):
        spec = rig.sensors[name]
        offset, stddev = clocks[k].tolist() if name != root else (None, None)
        sensors.append(
            SensorPose(
                name,
                parents.get(name),
                spec.frame_id or result.frames.get(name) or name,
                spec.kind,
                located.T_root_scanner[k],
                verdicts[name],
                clock_offset=offset,
                clock_offset_stddev=stddev,
            )
        )
    T_first_world = se3.inverse(states[0].T_root_sensor)
    planar = _project_poses(names, states, result.observed)
    pairs = [(initial.names[a], initial.names[b]) for a, b in inliers.edges.tolist()]
    poses = {(a, b): (planar[a], planar[b]) for a, b in pairs} if solution else {}
    tracked: dict[str, ScannerTracks | Rejected] = {
        name: one if isinstance(one, Rejected) else start.corrected.tracked[name]
        for name, one in result.observed.items()
    }
    samples = {}
    for name, one in tracked.items():
        if isinstance(one, ScannerTracks):
            clock = states[names.index(name)].clock_offset if name in names else 0.0
            remaining = clock - start.corrected.clock_offset.get(name, 0.0)
            samples[name] = resample_tracks(correct_tracks(one, clock_offset=remaining))
    matches = match_across_scanners(samples, planar)
    return Calibration(
        root=names[0],
        sensors=tuple(sensors),
        joint_covariance=located.covariance,
        systematic=_list_drifts(names, solution, at) if solution else (),
        evidence=Evidence(
            estimator="joint",
            tolerance=rig.tolerance,
            edges=tuple(build_edge(pair, found, poses, parents) for pair, found in initial.pairs.items()),
            captures=build_walk_rows(samples, matches, result.begin),
            unconnected={
                name: _explain_unconnected(name, root, tracked, start) for name in rig.sensors if name not in names
            },
            remarks=tuple(finding.text for finding in result.findings),
            residuals={"positions": matches.residuals.ravel()} if len(matches.residuals) else {},
            fit=_describe_fit(names, solution) if solution else {},
            initial_poses={name: T_first_world @ start.states[name].T_root_sensor for name in names if solution},
        ),
        pictures=Pictures(
            floor_views=_build_views(tracked, samples, planar, result),
            T_plan_root=np.asarray(states[0].T_root_sensor),
        ),
    )


def _build_views(
    tracked: Mapping[str, ScannerTracks | Rejected],
    samples: Mapping[str, TrackSamples],
    planar: Mapping[str, Array],
    result: SpaceResult,
) -> tuple[FloorView, ...]:
    """Static points and walks of the connected sensors, thinned."""
    followed = {name: one for name, one in tracked.items() if isinstance(one, ScannerTracks)}
    views = []
    for view in build_floor_views(followed, samples, planar, result.begin):
        one = result.observed[view.sensor]
        points = thin_points(one.static.points) if isinstance(one, SpaceObservations) else np.zeros((0, 3))
        views.append(replace(view, points=points[:: len(points) // _MAX_POINTS + 1].astype(np.float32)))
    return tuple(views)


def _start_alone(observed: SpaceObservations | None) -> SensorState:
    """The state of a root to which nothing is connected, over its floor if it has one."""
    return SensorState(observed.T_floor_sensor if observed else np.eye(4))


def _explain_unconnected(
    name: str, root: str, tracked: Mapping[str, ScannerTracks | Rejected], start: SpaceStart
) -> str:
    """Why a sensor has no pose, and where people should walk."""
    pairs = start.initialization.pairs
    others = ", ".join(one for one in start.states if one != name)
    if name in start.states and others:
        reason = explain_unconnected(root, root, tracked, pairs)
        return f"is connected to {others}, but the root {root} is not: {reason}; {_WALK_IN}"
    reason = explain_unconnected(name, root, tracked, pairs)
    one, observed = tracked[name], start.observed.get(name)
    if not isinstance(one, ScannerTracks):
        return reason
    by_vehicles = observed is not None and observed.vehicles and not one.tracks
    return f"{'measured vehicles, but ' if by_vehicles else ''}{reason}; {_WALK_IN}"


def locate_sensors(names: Sequence[str], solution: SpaceSolution, covariance: Array | None = None) -> NetworkPoses:
    """The poses of a solution in the frame of its first sensor, with its covariance (P, P), or another one."""
    T = np.array([one.T_root_sensor for one in solution.states])
    T_first_world, S = se3.inverse(T[0]), len(T)
    whole = expand_covariance(solution.covariance if covariance is None else covariance, solution.free)
    pose = np.arange(solution.free.size).reshape(S, -1)[:, :6].ravel()
    turned = np.kron(np.eye(2 * S), T_first_world[:3, :3])
    return NetworkPoses(tuple(names), T_first_world @ T, turned @ whole[np.ix_(pose, pose)] @ turned.T)


def _relate_to(solution: SpaceSolution, root: int, column: int, numbers: Sequence[float]) -> Array:
    """(S, 2) numbers of the states less that of the root, and their standard deviations, by their column."""
    covariance = expand_covariance(solution.covariance, solution.free)
    rows = np.arange(solution.free.size).reshape(solution.free.shape)[:, column]
    covariance = covariance[np.ix_(rows, rows)]
    variance = np.diag(covariance) - 2 * covariance[root] + covariance[root, root]
    return np.column_stack([np.subtract(numbers, numbers[root]), np.sqrt(np.maximum(variance, 0.0))])


def _grade_poses(
    rig: Rig,
    names: Sequence[str],
    solution: SpaceSolution,
    observed: Mapping[str, SpaceObservations | Rejected],
    findings: Sequence[Finding],
) -> dict[str, Verdict]:
    """Verdicts on the poses relative to the root of the rig: a sensor, or the floor below the first."""
    root, settings = rig.reference, rig.settings.diagnostics.verdict
    at, by_scanner = names.index(root), rig.sensors[root].kind == "lidar2d"
    level = number_free(solution.free)[at, LEVELLING] if by_scanner else np.zeros(0, dtype=np.intp)
    exact = condition_on(solution.with_ranges, level)
    found, known, without_root = (
        _express_in_root(rig, locate_sensors(names, solution, covariance), observed, floor=floor)
        for covariance, floor in ((solution.covariance, True), (solution.with_ranges, True), (exact, False))
    )
    advice = {
        _RANGES: _RANGE_ADVICE,
        _FLOOR: _FLOOR_ADVICE.format(names[0]),
        _OF_ROOT: _LEVEL_ADVICE.format(f"the root {root}") + _ROOT_ADVICE,
    }
    by_stated = dict.fromkeys((_RANGES, _FLOOR, _STATED), _LEVEL_ADVICE.format("a 2-D scanner"))
    by_sensor = collect_findings(findings)
    # What makes the root weak makes all poses relative to it weak.
    of_all = by_sensor.get(root, [])
    verdicts = {rig.root: Verdict("good")}
    for name in found.names[1:]:
        k, rows = names.index(name), np.ix_(*[found.covariance_rows([name])] * 2)
        kind, T = rig.sensors[name].kind, found.T_root_scanner[found.names.index(name)]
        stddev, rest, least = (stddev_along_axes(T, one.covariance[rows]) for one in (found, known, without_root))
        shares = {_RANGES: 1 - (rest / stddev) ** 2}
        if by_scanner or rig.is_on_floor:
            shares[_OF_ROOT if by_scanner else _FLOOR] = (rest**2 - least**2) / stddev**2
        worst = int(np.argmax(stddev / max_good_stddev(rig.tolerance, settings)))
        is_stated = kind == "lidar2d" and worst in _LEVEL_AXES
        shares[_STATED if is_stated else _REST] = 1 - np.sum(list(shares.values()), axis=0)
        advised = advice | by_stated if is_stated else advice
        largest = max(shares, key=lambda source: float(shares[source][worst]))
        reasons = dict.fromkeys([*by_sensor.get(name, ()), *of_all])
        verdicts[name] = grade_pose(
            name, kind, T, found.covariance[rows],
            [*reasons, *(_find_contradictions(solution, k, at, kind == "lidar3d") if k != at else ())],
            tolerance=rig.tolerance, settings=settings,
            data=_REST,
            advice=advised.get(largest) or _advise_walks(names, solution, k),
            shares=shares,
        )  # fmt: skip
    return verdicts


def _express_in_root(
    rig: Rig, poses: NetworkPoses, observed: Mapping[str, SpaceObservations | Rejected], *, floor: bool
) -> NetworkPoses:
    """The poses in the frame of the root of the rig; if that is the floor, with or without its covariance."""
    reference = observed[poses.names[0]]
    if rig.is_on_floor and isinstance(reference, SpaceObservations):
        T = reference.T_floor_sensor
        return poses.express_in(rig.root, T, floor * spread_floor(T, reference.floor_covariance))
    return poses.change_root(rig.root)


def _advise_walks(names: Sequence[str], solution: SpaceSolution, k: int) -> str:
    """Between sensor k and which other people should walk: the one with most common people, and nearest."""
    common = np.zeros(len(names))
    for one in solution.persons:
        common[one.sensors] += k in one.sensors
    places: Array = np.array([state.T_root_sensor[:3, 3] for state in solution.states])
    order = np.lexsort((np.linalg.norm(places - places[k], axis=1), -common))
    return _ADVICE.format(names[k], names[int(order[order != k][0])])


def _find_contradictions(solution: SpaceSolution, k: int, root: int, measures_floor: bool) -> list[str]:
    """Why the pose of sensor k, which measures floors or not, relative to the root cannot be good."""
    reasons = []
    if solution.squared_step > _MAX_SQUARED_STEP:
        reasons.append("the joint solution has not converged")
    for sensor, name in ((k, "it"), (root, "the root")):
        by_persons = any(sensor in one.sensors for one in solution.persons)
        if not by_persons and not any(sensor in one.sensors for one in solution.vehicles):
            reasons.append(
                f"no person or vehicle was measured by {name} and another sensor at the same time and place"
            )
    level = count_level_cells(solution.shared, len(solution.states)) >= _MIN_LEVEL_CELLS
    connected = label_parts(len(solution.states), np.argwhere(level))
    if measures_floor and connected[0] != connected[k]:
        reasons.append(
            "it and other LiDARs measured less than three places of the same floor, so that its height rests on "
            "walls: let more of the same floor be in the views of both"
        )
    agree = (solution.agreement >= _MIN_AGREEMENT) & (solution.balance >= _MIN_BALANCE)
    connected = label_parts(len(solution.states), np.argwhere(agree))
    if connected[root] != connected[k]:
        reasons.append(
            "walls that it measured do not agree with those of other sensors: let more of the same walls, pillars "
            "and furniture be in the views of both"
        )
    return reasons


def _list_drifts(names: Sequence[str], solution: SpaceSolution, root: int) -> tuple[EstimatedParameter, ...]:
    """The drifts of the clocks that may drift from that of the root."""
    prior = np.hypot(solution.prior[:, DRIFT], solution.prior[root, DRIFT])
    found = _relate_to(solution, root, DRIFT, [one.timing[0] for one in solution.states])
    # The scatter of clusters widens what the prior determines as well.
    found[:, 1] = np.minimum(found[:, 1], prior)
    rows = zip(names, prior.tolist(), found.tolist(), strict=True)
    return tuple(
        EstimatedParameter(name, "clock drift", "", 0.0, stated, *estimate)
        for k, (name, stated, estimate) in enumerate(rows)
        if stated > 0 and k != root
    )


def _project_poses(
    names: Sequence[str], states: Sequence[SensorState], observed: Mapping[str, SpaceObservations | Rejected]
) -> dict[str, Array]:
    """Poses (3, 3) in the levelled plane of the root of the levelled planes of sensors."""
    planar = {}
    for name, state in zip(names, states, strict=True):
        one = observed[name]
        if isinstance(one, SpaceObservations):
            T = state.T_root_sensor @ se3.inverse(one.T_floor_sensor)
            planar[name] = se2.pose(float(np.arctan2(T[1, 0], T[0, 0])), T[:2, 3])
    return planar


def _describe_fit(names: Sequence[str], solution: SpaceSolution) -> dict[str, FitError]:
    """Residuals of the static points of each sensor on surfaces that others measured, too."""
    counts = np.bincount(solution.shared.sensor, minlength=len(names))
    found = zip(names, counts.tolist(), solution.noise.white.tolist(), strict=True)
    return {name: FitError(count, "m", rms) for name, count, rms in found if count}

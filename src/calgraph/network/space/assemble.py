"""Assembles the Calibration of a network in space: poses with verdicts, and what contradicts them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Lidar2dSpec, Rig
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
from calgraph.network.pairs.synchronized_tracks import TrackSamples, resample_tracks
from calgraph.network.space.joint import SpaceSolution
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.on_floor import spread_floor
from calgraph.network.space.start import SpaceStart
from calgraph.network.space.static_surfaces import thin_points
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
from calgraph.surfaces.sensor_states import BESIDE_POSE, TIMING, SensorState, expand_covariance
from calgraph.verdict.grades import LONE_ROOT, collect_findings, grade_pose, max_good_stddev

_ADVICE = "let people walk farther and in more directions between {} and {}"
_RANGE_ADVICE = (
    "measure the range errors of the sensors at known distances, and state what is left in rig.yaml "
    "(uncertainty: range_scale, range_bias)"
)
_LEVEL_ADVICE = (
    "the walls and people that a 2-D scanner measures do not show its height, roll and pitch: measure these, and "
    "state them in rig.yaml (height, roll, pitch, and uncertainty: tilt)"
)
_WALK_IN = "let people walk from its view into those of its neighbours, with turns"
_FLOOR_ADVICE = (
    "let more of the floor be in the view of {}, and state the biases of its ranges (uncertainty: range_bias, "
    "ring_bias)"
)
# Sources of uncertainty, of which the largest in the most uncertain axis is what to improve. That of height and
# tilt of a 2-D scanner is what is stated.
_RANGES, _FLOOR, _REST, _STATED = "range errors", "the floor", "walks and surfaces", "stated height and tilt"
# Squared last step of the joint solution, in standard deviations, up to which it has converged.
_MAX_SQUARED_STEP = 0.1
# Walls on which two maps agree, less the others, and that over both, below which nothing but people shows that a
# pose is right. In simulated halls with 16 and 32 rings right pairs have 20 to 83, and 0.87 to 1.0; wrong ones are
# at most 0.54 if they are 0.2 to 3 m or 1 to 20 degrees off, and 0.4 after half a turn, which maps walls of a hall
# onto each other. Numbers do not distinguish these: they are up to 31.
_MIN_AGREEMENT, _MIN_BALANCE = 4.0, 0.6
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
    """Of the sensors with a start, in its order; None if that is the root only."""
    findings: Sequence[Finding]


def assemble_space(rig: Rig, result: SpaceResult) -> Calibration:
    """The calibration of a network in space: rooted at a sensor, with poses graded against the root of the rig."""
    solution, start, reference = result.solution, result.start, rig.reference
    names = list(start.states) if solution else [reference]
    states = solution.states if solution else [start.states.get(reference, SensorState(np.eye(4)))]
    T_root_world = se3.inverse(states[0].T_root_sensor)
    covariance, clocks = np.zeros((6, 6)), np.zeros(1)
    if solution:
        covariance, clocks = express_in_root(solution, solution.covariance, T_root_world)
        untimed = np.array([start.observed[name].untimed for name in names])
        clocks = np.sqrt(clocks**2 + (untimed**2 + untimed[0] ** 2) / 12)
    by_sensor = collect_findings(result.findings)
    initial = start.initialization
    inliers = initial.graph.select_edges(initial.solution.inliers)
    parents = find_parents(inliers, initial.names)
    errors, known, of_floor = _list_errors(rig, result)
    sensors = []
    for k, name in enumerate(names):
        spec, block = rig.sensors[name], slice(6 * k, 6 * k + 6)
        T = np.asarray(T_root_world @ states[k].T_root_sensor)
        verdict = LONE_ROOT if solution is None else Verdict("good")
        if solution is not None and (k or rig.is_on_floor):
            T_world_sensor = states[k].T_root_sensor
            stddev, rest, floor = (
                stddev_along_axes(T_world_sensor, one[block, block]) for one in (errors, known, of_floor)
            )
            shares = {_RANGES: 1 - (rest / stddev) ** 2}
            if rig.is_on_floor:
                shares[_FLOOR] = (floor / stddev) ** 2
            worst = int(np.argmax(stddev / max_good_stddev(rig.tolerance, rig.settings.diagnostics.verdict)))
            is_stated = isinstance(spec, Lidar2dSpec) and worst in _LEVEL_AXES
            shares[_STATED if is_stated else _REST] = 1 - np.sum(list(shares.values()), axis=0)
            largest = max(shares, key=lambda source: float(shares[source][worst]))
            advice = {_RANGES: _RANGE_ADVICE, _FLOOR: _FLOOR_ADVICE.format(reference)}.get(
                largest, _advise_walks(names, solution, k)
            )
            advice = _LEVEL_ADVICE if is_stated else advice
            verdict = grade_pose(
                name, spec.kind, T_world_sensor, errors[block, block],
                [*by_sensor.get(name, ()), *(_find_contradictions(solution, k) if k else ())],
                tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict,
                data=_REST,
                advice=advice,
                shares=shares,
            )  # fmt: skip
        sensors.append(
            SensorPose(
                name,
                parents.get(name),
                spec.frame_id or result.frames.get(name) or name,
                spec.kind,
                T,
                verdict,
                clock_offset=states[k].clock_offset if k else None,
                clock_offset_stddev=float(clocks[k]) if k else None,
            )
        )
    planar = _project_poses(names, states, result.observed)
    pairs = [(initial.names[a], initial.names[b]) for a, b in inliers.edges.tolist()]
    poses = {(a, b): (planar[a], planar[b]) for a, b in pairs}
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
        root=reference,
        sensors=tuple(sensors),
        joint_covariance=covariance,
        systematic=_list_drifts(names, solution) if solution else (),
        evidence=Evidence(
            estimator="joint",
            tolerance=rig.tolerance,
            edges=tuple(build_edge(pair, found, poses, parents) for pair, found in initial.pairs.items()),
            captures=build_walk_rows(samples, matches, result.begin),
            unconnected={
                name: explain_unconnected(name, reference, tracked, initial.pairs)
                + (f"; {_WALK_IN}" if isinstance(tracked[name], ScannerTracks) else "")
                for name in rig.sensors
                if name not in names
            },
            remarks=tuple(finding.text for finding in result.findings),
            residuals={"positions": matches.residuals.ravel()} if len(matches.residuals) else {},
            fit=_describe_fit(names, solution) if solution else {},
            initial_poses={name: T_root_world @ start.states[name].T_root_sensor for name in names if solution},
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


def _advise_walks(names: Sequence[str], solution: SpaceSolution, k: int) -> str:
    """Between sensor k and which other people should walk: the one with most common people, and nearest."""
    common = np.zeros(len(names))
    for one in solution.persons:
        common[one.sensors] += k in one.sensors
    places: Array = np.array([state.T_root_sensor[:3, 3] for state in solution.states])
    order = np.lexsort((np.linalg.norm(places - places[k], axis=1), -common))
    return _ADVICE.format(names[k], names[int(order[order != k][0])])


def _find_contradictions(solution: SpaceSolution, k: int) -> list[str]:
    """Why the pose of sensor k cannot be good."""
    reasons = []
    if solution.squared_step > _MAX_SQUARED_STEP:
        reasons.append("the joint solution has not converged")
    by_persons = any(k in one.sensors for one in solution.persons)
    if not by_persons and not any(k in one.sensors for one in solution.vehicles):
        reasons.append("no person or vehicle was measured by it and another sensor at the same time and place")
    agree = (solution.agreement >= _MIN_AGREEMENT) & (solution.balance >= _MIN_BALANCE)
    connected = label_parts(len(solution.states), np.argwhere(agree))
    if connected[0] != connected[k]:
        reasons.append(
            "walls that it measured do not agree with those of other sensors: let more of the same walls, pillars "
            "and furniture be in the views of both"
        )
    return reasons


def _list_errors(rig: Rig, result: SpaceResult) -> tuple[Array, Array, Array]:
    """Covariances (6S, 6S), in the world, of what is graded, of it without errors of ranges, and of the floor."""
    solution, reference = result.solution, result.observed[rig.reference]
    nothing = np.zeros((6, 6))
    if solution is None:
        return nothing, nothing, nothing
    found, known = (
        express_in_root(solution, one, np.eye(4))[0] for one in (solution.covariance, solution.with_ranges)
    )
    of_floor = np.zeros_like(found)
    if rig.is_on_floor and isinstance(reference, SpaceObservations):
        of_floor = spread_floor([one.T_root_sensor for one in solution.states], reference.floor_covariance)
    return found + of_floor, known + of_floor, of_floor


def express_in_root(solution: SpaceSolution, covariance: Array, T_root_world: Array) -> tuple[Array, Array]:
    """Covariance (6S, 6S) of poses in the axes of the root, and (S,) standard deviations of clocks, s.

    Args:
        solution: of the sensors.
        covariance: (P, P) of their free states.
        T_root_world: (4, 4) its world in the frame of the root.
    """
    S, whole = len(solution.states), expand_covariance(covariance, solution.free)
    numbers = np.arange(solution.free.size).reshape(S, -1)
    pose = numbers[:, :6].ravel()
    turned = np.kron(np.eye(2 * S), T_root_world[:3, :3])
    return turned @ whole[np.ix_(pose, pose)] @ turned.T, np.sqrt(np.diag(whole)[numbers[:, -BESIDE_POSE]])


def _list_drifts(names: Sequence[str], solution: SpaceSolution) -> tuple[EstimatedParameter, ...]:
    """Of the clocks that may drift."""
    variances = np.diag(expand_covariance(solution.covariance, solution.free)).reshape(solution.free.shape)
    rows = zip(names, solution.states, solution.prior[:, -TIMING], variances[:, -TIMING], strict=True)
    return tuple(
        EstimatedParameter(
            name, "clock drift", "", 0.0, float(prior), float(state.timing[0]), float(variance**0.5)
        )
        for name, state, prior, variance in rows
        if prior > 0
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

"""Drives: from one recording of a robot that drives to the poses of its LiDARs, which may share no view."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment, AdjustmentPriors, adjust_drive, change_root
from calgraph.drive.assemble import DriveResult, assemble_drive, describe_sensor_errors, measure_views
from calgraph.drive.board_views import SharedErrors
from calgraph.drive.board_world import chain_boards, describe_errors, measure_boards
from calgraph.drive.evidence import collect_pictures
from calgraph.drive.measurements import DrivePart
from calgraph.drive.options import DriveOptions
from calgraph.drive.segments import Segments
from calgraph.drive.sources import SOURCES, Reader, Source
from calgraph.drive.sources.camera import CameraSource, find_boards
from calgraph.drive.start import MotionStart, StartMotion, choose_lead, solve_starts
from calgraph.drive.start_places import add_heights, leave_open, place_scanners
from calgraph.drive.stated_poses import StatedPose, find_wrong_poses, resolve_stated_poses
from calgraph.drive.vehicle import assess_base
from calgraph.errors import CalibrationError, Rejected
from calgraph.geometry import Array, se_n
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import NO_CACHE, Recording, resolve_intrinsics
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.finding import Finding
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState, expand_covariance
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline
from calgraph.verdict.comparison import ExtrinsicsComparison
from calgraph.verdict.contradicted_poses import compare_with_contradictions
from calgraph.verdict.recorded_clocks import add_clock_offsets, correct_clocks
from calgraph.verdict.state_changes import describe_changes

# Length of a part with a separate world, s, and how many are adjusted: its unknowns are eliminated densely, 300
# control points of 6 in space, or of 3 in the plane, where cells are met again later. Parts that turn most are
# used.
_PART_DURATION, _MAX_PARTS = {2: 60.0, 3: 30.0}, 6
# Time between knots, s: vehicles swing at 1 to 2 Hz, which splines with ten knots a second follow; scans without
# times of points leave gaps in which nothing is measured, and need knots no denser than they are.
_KNOT_SPACING, _MAX_KNOT_SPACING = 0.1, 0.25


def calibrate_drive(
    rig: Rig, recording: Recording, options: DriveOptions = DriveOptions(), progress: Progress = no_progress
) -> Calibration:
    """Calibrates the sensors of a robot from a drive through surroundings, without a target and a common view.

    Args, Returns and Raises as for :func:`calgraph.calibrate_rig`.
    """
    check_sensor_topics(rig, recording)
    rig = resolve_intrinsics(rig, recording)
    recording, offsets, corrected = correct_clocks(rig, recording, NO_CACHE)
    monitor = InputMonitor(rig, recording.start)
    sources, frames = _read_sources(rig, recording, monitor, options, progress)
    findings = [*corrected, *monitor.findings()]
    return add_clock_offsets(calibrate_sources(rig, sources, frames, findings, options, progress), rig, offsets)


def calibrate_sources(
    rig: Rig,
    sources: Mapping[str, Source],
    frames: Mapping[str, str],
    findings: Sequence[Finding],
    options: DriveOptions,
    progress: Progress = no_progress,
) -> Calibration:
    """The calibration from what sensors measured, by name.

    Args:
        rig: with the intrinsics of all cameras.
        sources: of all its sensors.
        frames: that messages state.
        findings: what does not fit the rig in the messages.
        options: of the calibration.
        progress: called with the stage and the share that is done.
    """
    tracks = _track_sensors(rig, sources, options, progress)
    lead = _select_lead(rig, tracks)
    motions = {name: _select_motion(rig, lead, name) for name in rig.sensors}
    stated = resolve_stated_poses(rig, lead, frames, options.prior, dimension_of(rig))
    from_lead = add_heights(solve_starts(lead, tracks, motions, options.seed), lead, sources, stated)
    rng = np.random.default_rng([options.seed, len(tracks), 3])
    from_lead = place_scanners(from_lead, lead, tracks, sources, rng)
    used = [lead, *(name for name, start in from_lead.items() if isinstance(start, MotionStart))]
    starts = from_lead if lead == rig.root else _express_in_root(rig.root, lead, from_lead)
    if rig.root not in used or not (len(used) > 1 or (rig.base and isinstance(tracks[lead], Segments))):
        base = assess_base(rig, [], tracks, None)
        return assemble_drive(rig, DriveResult([rig.root], frames, starts, None, findings, base=base))
    adjusted, systematic = _adjust(rig, used, sources, tracks, from_lead, stated, options.seed, progress)
    findings = [*findings, *find_wrong_poses(stated, used, *_list_poses(adjusted))]
    adjusted = leave_open(
        adjusted, [start for name in used[1:] if isinstance(start := from_lead[name], MotionStart)]
    )
    systematic += describe_sensor_errors(rig, used, adjusted)
    root = used.index(rig.root)
    views = {name: measure_views(adjusted, k) for k, name in enumerate(used)}
    begin = adjusted.parts[0].trajectory.start
    findings = [*findings, *describe_changes(adjusted.changes, used, rig.root, begin)]
    pictures, base = collect_pictures(used, starts, adjusted, root), assess_base(rig, used, tracks, adjusted)
    if root:
        adjusted = change_root(adjusted, root)
        used = [rig.root, *(name for name in used if name != rig.root)]
    result = DriveResult(used, frames, starts, adjusted, findings, views, systematic, base, pictures)
    return assemble_drive(rig, result)


def _select_lead(rig: Rig, tracks: Mapping[str, Segments | Rejected]) -> str:
    """The sensor for which poses and trajectory are solved: a LiDAR, whose surfaces need its trajectory only."""
    kinds = {
        name: SOURCES[rig.sensors[name].kind]
        for name, track in tracks.items()
        if isinstance(track, Segments) and (dimension_of(rig) == 2 or rig.sensors[name].kind != "lidar2d")
    }
    lidars = [name for name, kind in kinds.items() if kind.has_surfaces]
    candidates = lidars or [name for name, kind in kinds.items() if kind.has_place]
    return choose_lead(rig.root, {name: tracks[name] for name in candidates}) if candidates else rig.root


def _express_in_root(
    root: str, lead: str, starts: Mapping[str, MotionStart | Rejected]
) -> dict[str, MotionStart | Rejected]:
    """The starts of all sensors but the root against it, from those against the sensor that leads."""
    of_root = starts[root]
    if isinstance(of_root, Rejected):
        missing = Rejected(f"the root {root} has no pose on the robot: {of_root.reason}")
        return {name: missing for name in (lead, *starts) if name != root}
    of_lead = replace(of_root, T_root_sensor=np.eye(len(of_root.T_root_sensor)), clock_offset=0.0)
    return {
        name: start if isinstance(start, Rejected) else start.relative_to(of_root)
        for name, start in {lead: of_lead, **starts}.items()
        if name != root
    }


def dimension_of(rig: Rig) -> int:
    """2 of rigs without cameras whose LiDARs all measure in one plane, otherwise 3."""
    lidars = {spec.kind for spec in rig.sensors.values() if SOURCES[spec.kind].has_surfaces}
    return 2 if lidars == {"lidar2d"} and not rig.cameras() else 3


def _read_sources(
    rig: Rig, recording: Recording, monitor: InputMonitor, options: DriveOptions, progress: Progress
) -> tuple[dict[str, Source], dict[str, str]]:
    """What each sensor measured, and the frames that messages state."""
    cameras, frames = find_boards(rig, recording, monitor, options.engine, progress)
    # One topic of tf has the trajectories of several frames.
    names: dict[str, list[str]] = {}
    for name, topic in rig.topics.items():
        if name not in cameras:
            names.setdefault(topic, []).append(name)
    n = dimension_of(rig)
    readers: dict[str, Reader] = {
        name: make_reader(rig, name, n, np.random.default_rng([options.seed, k]))
        for k, (name, spec) in enumerate(rig.sensors.items())
        if (make_reader := SOURCES[spec.kind].make_reader)
    }
    for record in monitor.observe(recording.records(list(names))) if names else ():
        message = record.decode()
        for name in names[record.topic]:
            if message.frame_id:
                frames.setdefault(name, message.frame_id)
            readers[name].add(message)
        progress("reading", (record.arrival - recording.start) / max(recording.end - recording.start, 1e-9))
    progress("reading", 1.0)
    read = {name: reader.finish() for name, reader in readers.items()}
    return {name: cameras[name] if name in cameras else read[name] for name in rig.sensors}, frames


def _track_sensors(
    rig: Rig, sources: Mapping[str, Source], options: DriveOptions, progress: Progress
) -> dict[str, Segments | Rejected]:
    """The trajectory of each sensor by itself."""
    work = [(sources[name], np.random.default_rng([options.seed, k, 1])) for k, name in enumerate(rig.sensors)]
    tracks: dict[str, Segments | Rejected] = {}
    progress("odometry", 0.0)
    for name, track in zip(rig.sensors, options.engine.map(_track_source, work), strict=True):
        tracks[name] = track
        progress("odometry", len(tracks) / len(work))
    return tracks


def _track_source(source: Source, rng: np.random.Generator) -> Segments | Rejected:
    return source.track(rng)


def _select_motion(rig: Rig, lead: str, name: str) -> StartMotion:
    """What the start of a sensor is found from: boards would be missed at a wrong height."""
    if not SOURCES[rig.sensors[name].kind].has_place:
        return "turn"
    kinds = {rig.sensors[lead].kind, rig.sensors[name].kind}
    return "level" if "camera" not in kinds and dimension_of(rig) == 3 else "free"


def _adjust(
    rig: Rig,
    used: list[str],
    sources: Mapping[str, Source],
    tracks: Mapping[str, Segments | Rejected],
    starts: Mapping[str, MotionStart | Rejected],
    stated: Mapping[str, StatedPose],
    seed: int,
    progress: Progress,
) -> tuple[Adjustment, tuple[EstimatedParameter, ...]]:
    """The joint solution of the sensors that have a start, and the errors of lenses and prints."""
    n = dimension_of(rig)
    states = [SensorState(np.eye(n + 1))]
    for name in used[1:]:
        start = starts[name]
        assert isinstance(start, MotionStart)
        states.append(SensorState(start.T_root_sensor, start.clock_offset))
    rng = np.random.default_rng([seed, len(rig.sensors)])
    thinned = [sources[name].thin(rng) for name in used]
    root = tracks[used[0]]
    assert isinstance(root, Segments)
    cameras = {k: source for k, source in enumerate(thinned) if isinstance(source, CameraSource)}
    if len(cameras) == len(used):
        chained = chain_boards(cameras, dict(enumerate(states)))
        root = Segments((chained,)) if chained else root
    errors, described, shared = describe_errors(rig, used)
    # LiDARs measure the trajectory between poses of other sensors.
    measuring = [k for k, name in enumerate(used) if SOURCES[rig.sensors[name].kind].has_surfaces]
    gap = max(thinned[k].gap for k in measuring or range(len(used)))
    spacing = float(np.clip(gap, _KNOT_SPACING, _MAX_KNOT_SPACING))
    parts = [
        _gather_part(
            thinned, states, fit_spline(track.between(start - spacing, end + spacing), start, end, spacing), errors
        )
        for track, start, end in _select_parts(root, _PART_DURATION[n])
    ]
    progress("adjusting", 0.0)
    stddev = np.array([SOURCES[rig.sensors[name].kind].stddev(rig.sensors[name], n) for name in used])
    stddev[0, : 1 - BESIDE_POSE] = 0.0
    priors = AdjustmentPriors(stddev, shared, {used.index(name): stated[name] for name in used if name in stated})
    try:
        adjusted = adjust_drive(parts, states, priors, lambda done: progress("adjusting", done))
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "the joint adjustment has no solution: start values are wrong, as odometry failed; drive slower, "
            "where walls and furniture are near"
        ) from error
    values = zip(described, adjusted.shared.tolist(), adjusted.shared_stddev.tolist(), strict=True)
    return adjusted, tuple(one.estimate(value, stddev) for one, value, stddev in values)


def _list_poses(adjusted: Adjustment) -> tuple[list[Array], list[Array]]:
    """Poses of all sensors, and their covariances as of independent errors, 0 where nothing is measured."""
    whole, size = expand_covariance(adjusted.independent_covariance, adjusted.free), adjusted.free.shape[1]
    starts = [(k * size, k * size + size - BESIDE_POSE) for k in range(len(adjusted.states))]
    return [state.T_root_sensor for state in adjusted.states], [whole[a:b, a:b] for a, b in starts]


def _gather_part(
    sources: Sequence[Source], states: Sequence[SensorState], trajectory: SplineTrajectory, errors: SharedErrors
) -> DrivePart:
    """What all sensors measured during a trajectory."""
    start, end = trajectory.start, trajectory.end
    both = list(zip(sources, states, strict=True))
    size = int(errors.prints[0, 0]) if errors.cameras else None
    return DrivePart(
        [source.points(start + state.clock_offset, end + state.clock_offset) for source, state in both],
        trajectory,
        [
            *(one for k, (source, state) in enumerate(both) for one in source.measurements(k, trajectory, state)),
            *measure_boards(sources, states, trajectory, errors),
        ],
        size,
    )


def _select_parts(root: Segments, duration: float) -> list[tuple[Track, float, float]]:
    """Intervals of segments of the root's trajectory, by its clock, s: those of a drive in which it turns most."""
    parts: list[tuple[Track, float, float]] = []
    turned: list[float] = []
    for track in root.tracks:
        first, last = float(track.times[0]), float(track.times[-1])
        edges = np.linspace(first, last, max(round((last - first) / duration), 1) + 1)
        turn = np.linalg.norm(se_n.log(se_n.rotation(se_n.inverse(track.poses[:-1]) @ track.poses[1:])), axis=1)
        for a, b in pairwise(edges.tolist()):
            parts.append((track, a, b))
            turned.append(float(turn[(track.times[1:] > a) & (track.times[1:] <= b)].sum()))
    best = np.sort(np.argsort(-np.array(turned), kind="stable")[:_MAX_PARTS])
    return [parts[k] for k in best]


def compare_drive_extrinsics(
    rig: Rig, recording: Recording, given: ExtrinsicsFile, options: DriveOptions, progress: Progress = no_progress
) -> tuple[Calibration, ExtrinsicsComparison]:
    """Comparison of given extrinsics with the calibration of a drive, by the rig's tolerance.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there; and as for
            :func:`calibrate_drive`.
    """
    calibration = calibrate_drive(rig, recording, options, progress)
    return calibration, compare_with_contradictions(rig, calibration, given, "motions")

"""Drives: from one recording of a robot that drives to the poses of its LiDARs, which may share no view."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment, AdjustmentPriors, adjust_drive
from calgraph.drive.assemble import DriveResult, assemble_drive
from calgraph.drive.base_verdict import assess_base
from calgraph.drive.measurements import DrivePart
from calgraph.drive.options import DriveOptions
from calgraph.drive.segments import Segments
from calgraph.drive.sources import SOURCES, Reader, Source
from calgraph.drive.start import MotionStart, explain_failure, solve_start
from calgraph.drive.states import SensorState
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import Calibration
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline

# Least time in which a sensor and the root measure both, s: some twenty relative motions.
_MIN_COMMON_TIME = 10.0
# Largest difference of clocks that is searched for, s.
_MAX_CLOCK_OFFSET = 0.6
# Length of a part with a separate world, s, and how many are adjusted: its unknowns are eliminated densely, 300
# control points of 6 in space, or of 3 in the plane, where cells are met again later. Parts that turn most are
# used.
_PART_DURATION, _MAX_PARTS = {2: 60.0, 3: 30.0}, 6
# Time between knots, s: vehicles swing at 1 to 2 Hz, which splines with ten knots a second follow; scans without
# times of points leave gaps in which nothing is measured, and need knots no denser than they are.
_KNOT_SPACING, _MAX_KNOT_SPACING = 0.1, 0.25


def calibrate_drive(
    rig: Rig, recording: Recording, options: DriveOptions, progress: Progress = no_progress
) -> Calibration:
    """Calibrates LiDARs of a robot from a drive: odometry of each, start by motion, joint adjustment.

    Args, Returns and Raises as for :func:`calgraph.calibrate_rig`.
    """
    check_sensor_topics(rig, recording)
    monitor = InputMonitor(rig, recording.start)
    sources, frames = _read_sources(rig, recording, monitor, options.seed, progress)
    tracks = _track_sensors(rig, sources, options, progress)
    starts = _solve_starts(rig, tracks, options.seed)
    used = [rig.root, *(name for name, start in starts.items() if isinstance(start, MotionStart))]
    adjusted = None
    if len(used) > 1 or (rig.base and isinstance(tracks[rig.root], Segments)):
        adjusted = _adjust(rig, used, sources, tracks, starts, options.seed, progress)
    result = DriveResult(used, frames, starts, adjusted, monitor.findings(), assess_base(rig, adjusted))
    return assemble_drive(rig, result)


def dimension_of(rig: Rig) -> int:
    """2 of rigs whose sensors all measure in one plane, otherwise 3."""
    return 2 if all(spec.kind == "lidar2d" for spec in rig.sensors.values()) else 3


def _read_sources(
    rig: Rig, recording: Recording, monitor: InputMonitor, seed: int, progress: Progress
) -> tuple[dict[str, Source], dict[str, str]]:
    """What each sensor measured, and the frames that messages state."""
    names = {topic: name for name, topic in rig.topics.items()}
    n = dimension_of(rig)
    readers: dict[str, Reader] = {
        name: SOURCES[spec.kind].make_reader(rig, name, recording, n, np.random.default_rng([seed, k]))
        for k, (name, spec) in enumerate(rig.sensors.items())
    }
    frames: dict[str, str] = {}
    for record in monitor.observe(recording.records(list(names))):
        name, message = names[record.topic], record.decode()
        if message.frame_id:
            frames.setdefault(name, message.frame_id)
        readers[name].add(message)
        progress("reading", (record.arrival - recording.start) / max(recording.end - recording.start, 1e-9))
    progress("reading", 1.0)
    return {name: reader.finish() for name, reader in readers.items()}, frames


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


def _solve_starts(
    rig: Rig, tracks: Mapping[str, Segments | Rejected], seed: int
) -> dict[str, MotionStart | Rejected]:
    """The start pose and clock of each sensor but the root, or why it has none."""
    root = tracks[rig.root]
    starts: dict[str, MotionStart | Rejected] = {}
    for k, (name, track) in enumerate(tracks.items()):
        if name == rig.root:
            continue
        if isinstance(track, Rejected):
            starts[name] = track
        elif isinstance(root, Rejected):
            starts[name] = Rejected(f"the root {rig.root} has no trajectory: {root.reason}")
        elif min(root.end, track.end) - max(root.start, track.start) < _MIN_COMMON_TIME:
            starts[name] = Rejected(f"it and the root measured together for under {_MIN_COMMON_TIME:g} s")
        else:
            start = solve_start(root, track, _MAX_CLOCK_OFFSET, np.random.default_rng([seed, k, 2]))
            failure = explain_failure(start, name)
            starts[name] = Rejected(failure) if failure else start
    return starts


def _adjust(
    rig: Rig,
    used: list[str],
    sources: Mapping[str, Source],
    tracks: Mapping[str, Segments | Rejected],
    starts: Mapping[str, MotionStart | Rejected],
    seed: int,
    progress: Progress,
) -> Adjustment:
    """The joint solution of the sensors that have a start."""
    root = tracks[rig.root]
    assert isinstance(root, Segments)
    n = dimension_of(rig)
    states = [SensorState(np.eye(n + 1))]
    for name in used[1:]:
        start = starts[name]
        assert isinstance(start, MotionStart)
        states.append(SensorState(start.T_root_sensor, start.clock_offset))
    rng = np.random.default_rng([seed, len(rig.sensors)])
    thinned = [sources[name].thin(rng) for name in used]
    spacing = float(np.clip(max(one.gap for one in thinned), _KNOT_SPACING, _MAX_KNOT_SPACING))
    parts = [
        _gather_part(
            thinned, states, fit_spline(track.between(start - spacing, end + spacing), start, end, spacing)
        )
        for track, start, end in _select_parts(root, _PART_DURATION[n])
    ]
    progress("adjusting", 0.0)
    stddev = np.array([SOURCES[rig.sensors[name].kind].stddev(rig.sensors[name], n) for name in used])
    return adjust_drive(parts, states, _fix_root(stddev), lambda done: progress("adjusting", done))


def _gather_part(
    sources: Sequence[Source], states: Sequence[SensorState], trajectory: SplineTrajectory
) -> DrivePart:
    """What all sensors measured during a trajectory."""
    start, end = trajectory.start, trajectory.end
    both = list(zip(sources, states, strict=True))
    return DrivePart(
        [source.points(start + state.clock_offset, end + state.clock_offset) for source, state in both],
        trajectory,
        [one for k, (source, state) in enumerate(both) for one in source.measurements(k, trajectory, state)],
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


def _fix_root(stddev: Array) -> AdjustmentPriors:
    """Priors from standard deviations (S, n + d + 3); pose and clock of the root, which is the first, are 0."""
    stddev = stddev.copy()
    stddev[0, :-2] = 0.0
    return AdjustmentPriors(stddev[:, :-3], stddev[:, -3], stddev[:, -2], stddev[:, -1])

"""Drives: from one recording of a robot that drives to the poses of its LiDARs, which may share no view."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment, AdjustmentPriors, adjust_drive
from calgraph.drive.assemble import DriveResult, assemble_drive
from calgraph.drive.measurements import DrivePart
from calgraph.drive.odometry import track_sensor
from calgraph.drive.options import DriveOptions
from calgraph.drive.start import MotionStart, explain_failure, solve_start
from calgraph.drive.states import SensorPoints, SensorState
from calgraph.drive.sweeps import Sweep, read_sweep, thin_sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import Calibration
from calgraph.sensors import LaserScan, PointCloud
from calgraph.sensors.kinds.stated import RangeUncertainty
from calgraph.surfaces.trajectory import Track, fit_spline

# Points of a sweep that are kept, registered in odometry, and adjusted: cells of 1 m within 10 m have some ten of
# 4000, and bodies of a room are met by ten of 150.
_KEPT_POINTS, _TRACKED_POINTS, _ADJUSTED_POINTS = 4000, 600, 150
# Sweeps below which there is no motion to compare: three relative motions of 1.5 s at 10 Hz.
_MIN_SWEEPS = 50
# Least time in which a sensor and the root measure both, s: some twenty relative motions.
_MIN_COMMON_TIME = 10.0
# Largest difference of clocks that is searched for, s.
_MAX_CLOCK_OFFSET = 0.6
# Standard deviation of a clock offset before the adjustment, s: turn rates determine it to a sweep's period.
_CLOCK_STDDEV = 0.1
# Of poses: no prior, but a number that is far above what any robot measures, m and rad.
_POSE_STDDEV = 10.0
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
    sweeps, frames = _read_sweeps(rig, recording, monitor, options.seed)
    progress("reading", 1.0)
    tracks = _track_sensors(rig, sweeps, options, progress)
    starts = _solve_starts(rig, tracks, options.seed)
    used = [rig.root, *(name for name, start in starts.items() if isinstance(start, MotionStart))]
    adjusted = None
    if len(used) > 1:
        adjusted = _adjust(rig, used, sweeps, tracks, starts, options.seed, progress)
    result = DriveResult(used, frames, starts, adjusted, monitor.findings())
    return assemble_drive(rig, result)


def dimension_of(rig: Rig) -> int:
    """2 of rigs whose sensors all measure in one plane, otherwise 3."""
    return 2 if all(spec.kind == "lidar2d" for spec in rig.sensors.values()) else 3


def _read_sweeps(
    rig: Rig, recording: Recording, monitor: InputMonitor, seed: int
) -> tuple[dict[str, list[Sweep]], dict[str, str]]:
    """The sweeps of each sensor, thinned, in order of their times; and the frames that messages state."""
    names = {topic: name for name, topic in rig.topics.items()}
    n = dimension_of(rig)
    rngs = {name: np.random.default_rng([seed, k]) for k, name in enumerate(rig.sensors)}
    sweeps: dict[str, list[Sweep]] = {name: [] for name in rig.sensors}
    frames: dict[str, str] = {}
    for record in monitor.observe(recording.records(list(names))):
        name, message = names[record.topic], record.decode()
        if not isinstance(message, LaserScan | PointCloud):
            continue
        frames.setdefault(name, message.frame_id)
        sweep = thin_sweep(read_sweep(message, n), _KEPT_POINTS, rngs[name])
        if len(sweep.points):
            sweeps[name].append(sweep)
    return {name: _order(some) for name, some in sweeps.items()}, frames


def _order(sweeps: list[Sweep]) -> list[Sweep]:
    """Sweeps by their times, without those of equal times: some drivers send messages twice."""
    ordered = sorted(sweeps, key=lambda sweep: sweep.time)
    return [sweep for k, sweep in enumerate(ordered) if k == 0 or sweep.time > ordered[k - 1].time]


def _track_sensors(
    rig: Rig, sweeps: Mapping[str, list[Sweep]], options: DriveOptions, progress: Progress
) -> dict[str, Track | Rejected]:
    """The trajectory of each sensor by its own odometry."""
    n = dimension_of(rig)
    tracks: dict[str, Track | Rejected] = {}
    for name, some in sweeps.items():
        if rig.sensors[name].kind == "lidar2d" and n == 3:
            tracks[name] = Rejected("a 2-D scanner is calibrated in a drive with other 2-D scanners only")
        elif len(some) < _MIN_SWEEPS:
            tracks[name] = Rejected(f"it has {len(some)} sweeps with points; a drive needs {_MIN_SWEEPS}")
    work = [
        (sweeps[name], _TRACKED_POINTS, np.random.default_rng([options.seed, k, 1]))
        for k, name in enumerate(rig.sensors)
        if name not in tracks
    ]
    tracked = [name for name in rig.sensors if name not in tracks]
    for k, (name, track) in enumerate(zip(tracked, options.engine.map(track_sensor, work), strict=True)):
        tracks[name] = track
        progress("odometry", (k + 1) / len(tracked))
    return tracks


def _solve_starts(
    rig: Rig, tracks: Mapping[str, Track | Rejected], seed: int
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
        elif min(root.times[-1], track.times[-1]) - max(root.times[0], track.times[0]) < _MIN_COMMON_TIME:
            starts[name] = Rejected(f"it and the root measured together for under {_MIN_COMMON_TIME:g} s")
        else:
            start = solve_start(root, track, _MAX_CLOCK_OFFSET, np.random.default_rng([seed, k, 2]))
            failure = explain_failure(start, name)
            starts[name] = Rejected(failure) if failure else start
    return starts


def _adjust(
    rig: Rig,
    used: list[str],
    sweeps: Mapping[str, list[Sweep]],
    tracks: Mapping[str, Track | Rejected],
    starts: Mapping[str, MotionStart | Rejected],
    seed: int,
    progress: Progress,
) -> Adjustment:
    """The joint solution of the sensors that have a start."""
    root = tracks[rig.root]
    assert isinstance(root, Track)
    n = dimension_of(rig)
    states = [SensorState(np.eye(n + 1))]
    for name in used[1:]:
        start = starts[name]
        assert isinstance(start, MotionStart)
        states.append(SensorState(start.T_root_sensor, start.clock_offset))
    rng = np.random.default_rng([seed, len(rig.sensors)])
    thinned = [[thin_sweep(sweep, _ADJUSTED_POINTS, rng) for sweep in sweeps[name]] for name in used]
    spacing = _select_spacing(thinned)
    parts = [
        DrivePart(
            [
                _gather(some, start + state.clock_offset, end + state.clock_offset)
                for some, state in zip(thinned, states, strict=True)
            ],
            fit_spline(root.between(start - spacing, end + spacing), start, end, spacing),
        )
        for start, end in _select_parts(root, _PART_DURATION[n])
    ]
    return adjust_drive(parts, states, _state_priors(rig, used, n), lambda done: progress("adjusting", done))


def _select_parts(root: Track, duration: float) -> list[tuple[float, float]]:
    """Intervals of the root's clock, s: those of a drive in which it turns most."""
    first, last = float(root.times[0]), float(root.times[-1])
    count = max(round((last - first) / duration), 1)
    edges = np.linspace(first, last, count + 1)
    turn = np.linalg.norm(se_n.log(se_n.rotation(se_n.inverse(root.poses[:-1]) @ root.poses[1:])), axis=1)
    turned = np.array([
        turn[(root.times[1:] > a) & (root.times[1:] <= b)].sum() for a, b in pairwise(edges)
    ])  # fmt: skip
    best = np.sort(np.argsort(-turned, kind="stable")[:_MAX_PARTS])
    return [(float(edges[k]), float(edges[k + 1])) for k in best]


def _select_spacing(thinned: list[list[Sweep]]) -> float:
    """Time between knots, s: no less than the gaps in which a sensor measures nothing."""
    gaps = [float(np.median([b.times.min() - a.times.max() for a, b in pairwise(some)])) for some in thinned]
    return float(np.clip(max(gaps), _KNOT_SPACING, _MAX_KNOT_SPACING))


def _gather(sweeps: list[Sweep], start: float, end: float) -> SensorPoints:
    """The points of sweeps within an interval of the sensor's clock, with those that clocks may shift into it."""
    near = [sweep for sweep in sweeps if start - 1.0 <= sweep.time <= end + 1.0]
    if not near:
        return SensorPoints(np.zeros((0, sweeps[0].points.shape[1])), np.zeros(0))
    return SensorPoints(np.concatenate([one.points for one in near]), np.concatenate([one.times for one in near]))


def _state_priors(rig: Rig, used: list[str], n: int) -> AdjustmentPriors:
    """Standard deviations before the adjustment, from rig.yaml."""
    count, pose = len(used), np.full((len(used), n + n * (n - 1) // 2), _POSE_STDDEV)
    clock = np.full(count, _CLOCK_STDDEV)
    pose[0], clock[0] = 0.0, 0.0
    uncertainty: list[RangeUncertainty] = []
    for name in used:
        stated = rig.sensors[name].uncertainty
        assert isinstance(stated, RangeUncertainty)
        uncertainty.append(stated)
    bias: Array = np.array([one.range_bias for one in uncertainty])
    scale: Array = np.array([one.range_scale for one in uncertainty])
    return AdjustmentPriors(pose, clock, bias, scale)

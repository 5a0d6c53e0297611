"""Networks in space: from one recording of people walking through a hall to the poses of its sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Cylinder, Lidar2dSpec, Lidar2dUncertainty, Lidar3dSpec, Rig
from calgraph.config.settings import TrackingSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array
from calgraph.network.checks.extension import EARLIER_WEIGHT, build_consistent_prior, merge_with_earlier
from calgraph.network.checks.findings import collect_network_findings
from calgraph.network.joint.planar_poses import ScannerPrior, extract_poses
from calgraph.network.options import NetworkOptions
from calgraph.network.space.assemble import SpaceResult, assemble_space, locate_sensors
from calgraph.network.space.bodies import find_bodies
from calgraph.network.space.body_tracks import track_bodies
from calgraph.network.space.floor_plane import find_floor
from calgraph.network.space.joint import SpaceSolution, solve_space
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.roots import change_root, express_in_reference, express_on_floor, list_references
from calgraph.network.space.start import SpaceStart, start_in_space
from calgraph.network.space.static_directions import CloudSplitter
from calgraph.network.space.vehicles import find_vehicles
from calgraph.network.track_recording import track_with_beam_times
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.engine import MapEngine
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.progress import Progress
from calgraph.recording import Recording, RecordingReference, refer_to
from calgraph.recording.input_checks import InputMonitor, TopicObservations
from calgraph.result import Calibration
from calgraph.result.finding import Finding
from calgraph.sensors import PointCloud
from calgraph.sensors.kinds import SensorSpec
from calgraph.surfaces.sensor_states import TIMING
from calgraph.verdict.state_changes import describe_changes

# LiDARs that are read together, 150 MB each until their points are split; batches for each worker, as of scanners.
_MAX_TOGETHER, _BATCHES_PER_WORKER = 10, 4
# Standard deviations of start poses, m and rad, and clocks, s: they are known to a tenth of that.
_PLACE_STDDEV, _ROTATION_STDDEV, _CLOCK_STDDEV = 1.0, 0.2, 0.1
# Of roll and pitch, rad (1.7°), assumed: sensors are level over floors, whose slopes differ by ramps of a few
# percent. With 0.2 rad, a wrong start pose of two LiDARs turned by 10° until their walls agreed, with this by 3°.
_SLOPE_STDDEV = 0.03
# Standard deviation of the drift of a LiDAR's clock: oscillators are those of 2-D scanners.
_CLOCK_DRIFT = Lidar2dUncertainty().clock_drift


def has_lidars(rig: Rig) -> bool:
    """Whether a network is one in space: it has a 3-D LiDAR."""
    return any(isinstance(spec, Lidar3dSpec) for spec in rig.sensors.values())


def check_space(rig: Rig, options: NetworkOptions) -> None:
    """Checks what is asked of a network in space.

    Raises:
        InputError: a sensor is of another kind, the target is not people, or the estimator is of planar networks.
    """
    for name, spec in rig.sensors.items():
        _scanning_spec(name, spec)
    if isinstance(rig.target, Cylinder):
        raise InputError("target.kind: must be people for a network of 3-D LiDARs, got cylinder")
    estimator = options.select_method(rig.settings.published).estimator
    if estimator != "joint":
        raise InputError(f"`estimator`: must be joint for a network of 3-D LiDARs, got {estimator}")


def calibrate_in_space(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    earlier: Calibration | None,
    monitor: InputMonitor,
    findings: Sequence[Finding],
    progress: Progress,
) -> Calibration:
    """Calibrates stationary 3-D LiDARs, and 2-D scanners, from people who walk through their views.

    Args:
        rig: the network, which :func:`check_space` allows.
        recording: of its sensors, by one clock.
        options: how to calibrate.
        earlier: the calibration to extend, without the sensors that have moved since.
        monitor: observes the messages.
        findings: of clocks.
        progress: called with the step and the fraction done.

    Raises:
        InputError: the earlier calibration lacks the LiDAR against which the network is to be solved.
        CalibrationError: nothing is connected to the root of a network that is to be extended, or it has moved.
    """
    references = list_references(rig, earlier)
    observed, frames = _observe(rig, recording, options, monitor, progress)
    tracked, of_scanners, found = _track_scanners(rig, recording, options, monitor, progress)
    scanners = {name: one for name, one in tracked.items() if isinstance(one, ScannerTracks)}
    measured = {name: one for name, one in observed.items() if isinstance(one, SpaceObservations)}
    solved, start = _start(rig, references, measured, scanners, earlier, options, progress)
    findings = [*findings, *monitor.findings(), *found]
    findings += _describe_steps(solved.root, list(start.states), measured, recording.start)
    findings += _describe_untimed(measured)
    findings += start.corrected.findings
    findings += collect_network_findings(rig.root, tracked, start.initialization, recording.start)
    solution = prior = None
    if rig.reference in start.states and len(start.states) > 1:
        names = list(start.states)
        with options.engine.keep_workers(rig.settings.estimation.network.max_kept_bytes) as engine:
            solution = _solve(solved, start, engine, progress)
            if earlier is not None:
                earlier = express_in_reference(earlier, solved.root)
                poses, found_poses = extract_poses(earlier), locate_sensors(names, solution)
                prior = build_consistent_prior(poses, found_poses, rig.reference, rig.settings.diagnostics)
                solution = _solve(solved, start, engine, progress, prior).scale_covariance(1 / EARLIER_WEIGHT)
        findings += describe_changes(solution.changes, names, rig.root, solution.begin)
    rejected = {name: one for name, one in (observed | tracked).items() if isinstance(one, Rejected)}
    result = SpaceResult(
        {name: rejected.get(name) or start.observed[name] for name in rig.sensors}, frames | of_scanners, start,
        recording.start, solution, findings,
    )  # fmt: skip
    calibration = assemble_space(rig, result)
    if earlier is not None:
        calibration = merge_with_earlier(calibration, earlier, prior)
    if not rig.is_on_floor:
        return change_root(calibration, rig.root)
    of_reference = observed[rig.reference]
    if isinstance(of_reference, Rejected):
        return calibration
    return express_on_floor(calibration, of_reference)


def _start(
    rig: Rig,
    references: Sequence[str],
    measured: Mapping[str, SpaceObservations],
    scanners: Mapping[str, ScannerTracks],
    earlier: Calibration | None,
    options: NetworkOptions,
    progress: Progress,
) -> tuple[Rig, SpaceStart]:
    """The start of a network, and the rig with the LiDAR as root against which it is solved.

    It is the first that is connected to the root of the rig, and the last if none is.
    """
    candidates = [name for name in references if name in measured] or list(references[:1])
    tried: set[str] = set()
    for name in candidates:
        # What is connected to one of them is not to the root: others are tried only if the first is not.
        if name in tried:
            continue
        solved = rig.model_copy(update={"root": name})
        level = earlier
        if earlier is not None and name in measured:
            # Poses over the floor show which scanners are upside-down.
            level = express_on_floor(express_in_reference(earlier, name), measured[name])
        rng = np.random.default_rng(options.seed)
        start = start_in_space(solved, measured, scanners, replace(options, extend=level), rng, progress)
        if rig.reference in start.states:
            return solved, start
        tried |= set(start.states)
    return solved, start


def _observe(
    rig: Rig, recording: Recording, options: NetworkOptions, monitor: InputMonitor, progress: Progress
) -> tuple[dict[str, SpaceObservations | Rejected], dict[str, str]]:
    """What each 3-D LiDAR measured, and the frames that messages state.

    Each call reads the recording by itself, as with scanners: passing over the messages of others takes little.
    """
    names = [name for name, spec in rig.sensors.items() if isinstance(spec, Lidar3dSpec)]
    engine = options.engine
    # One worker reads as many together as it may.
    batches = _BATCHES_PER_WORKER * engine.workers if engine.workers > 1 else 1
    size = min(_MAX_TOGETHER, -(-len(names) // batches))
    parts = [names[k : k + size] for k in range(0, len(names), size)]
    shared = Kept.of((rig, refer_to(recording, rig.settings.limits), options.seed))
    observed: dict[str, SpaceObservations | Rejected] = {}
    frames: dict[str, str] = {}
    for found in engine.map(_observe_batch, [(shared, part) for part in parts]):
        for name, one in found.items():
            observed[name] = one.observations
            if one.frame is not None:
                frames[name] = one.frame
            monitor.restore(rig.topics[name], one.of_topic)
        progress("tracking", len(observed) / len(names))
    return observed, frames


def _track_scanners(
    rig: Rig, recording: Recording, options: NetworkOptions, monitor: InputMonitor, progress: Progress
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str], Sequence[Finding]]:
    """Tracks of the 2-D scanners, the frames that messages state, and what was found about the times of beams."""
    specs = {name: spec for name, spec in rig.sensors.items() if isinstance(spec, Lidar2dSpec)}
    if not specs:
        return {}, {}, ()
    planar = rig.model_copy(update={"sensors": specs, "root": next(iter(specs))})
    tracks, frames, findings = track_with_beam_times(planar, recording, options, progress, monitor)
    return tracks, frames, findings


@dataclass(frozen=True, eq=False)
class _Observed:
    """What one pass over the messages of a sensor yields."""

    observations: SpaceObservations | Rejected
    frame: str | None
    """That its first message states; None where it has none."""
    of_topic: TopicObservations


def _observe_batch(shared: tuple[Rig, RecordingReference, int], names: Sequence[str]) -> dict[str, _Observed]:
    """Reads the messages of some sensors, and finds what each measured."""
    rig, reference, seed = shared
    by_topic = {rig.topics[name]: name for name in names}
    splitters = {name: CloudSplitter() for name in names}
    frames: dict[str, str] = {}
    with reference.open() as recording:
        monitor = InputMonitor(rig, recording.start)
        for record in monitor.observe(recording.records(list(by_topic))):
            name, message = by_topic[record.topic], record.decode()
            if isinstance(message, PointCloud):
                frames.setdefault(name, message.frame_id)
                splitters[name].add(message)
    found = {}
    for name in names:
        rng = np.random.default_rng([seed, list(rig.sensors).index(name)])
        spec = rig.sensors[name]
        assert isinstance(spec, Lidar3dSpec)
        observations = observe_clouds(splitters.pop(name), spec, rig.settings.tracking, rng)
        found[name] = _Observed(observations, frames.get(name), monitor.observations(rig.topics[name]))
    return found


def _scanning_spec(name: str, spec: SensorSpec) -> Lidar2dSpec | Lidar3dSpec:
    if not isinstance(spec, Lidar2dSpec | Lidar3dSpec):
        raise InputError(
            f"sensors.{name}.kind: must be lidar3d or lidar2d beside 3-D LiDARs that people calibrate, got "
            f"{spec.kind}; give other sensors a separate rig.yaml"
        )
    return spec


def _describe_steps(
    root: str, names: Sequence[str], measured: Mapping[str, SpaceObservations], begin: float
) -> list[Finding]:
    """A finding for each LiDAR that moved during the recording.

    Args:
        root: the LiDAR against which the network is solved: if it moved, all poses are weak.
        names: of the connected sensors, 2-D scanners included.
        measured: by LiDAR.
        begin: of the recording, s.
    """
    return [
        Finding(
            f"{name} moved {one.step.time - begin:.0f} s from the start, by {1000 * one.step.shift:.1f} mm and "
            f"{np.degrees(one.step.turn):.2f}° relative to what stands still: fix it firmly, and record again",
            tuple(names) if name == root else (name,),
        )
        for name, one in measured.items()
        if one.step is not None
    ]


def _describe_untimed(measured: Mapping[str, SpaceObservations]) -> list[Finding]:
    """A finding about the sensors whose points have no times, which makes none of them weak."""
    names = [name for name, one in measured.items() if one.untimed_sweep]
    if not names:
        return []
    longest = max(measured[name].untimed_sweep for name in names)
    # Times are wrong by the same at each azimuth, and what stands still needs none. In four halls with LiDARs of
    # 32 rings, 60 s have errors of 2 to 15 mm at standard deviations of 14 to 30 mm, and squared errors over the
    # covariance are 0.1 to 1.4. In two where all walk one way, they are 0.6 to 1.5 after 30 s, and poses are
    # within 4 mm of those with times.
    return [
        Finding(
            f"clouds of {', '.join(names)} have no times of points, which are up to a sweep "
            f"({1000 * longest:.0f} ms) from their stamps: their clock offsets are uncertain by that; let "
            "their drivers write them"
        )
    ]


def _solve(
    rig: Rig, start: SpaceStart, engine: MapEngine, progress: Progress, earlier: ScannerPrior | None = None
) -> SpaceSolution:
    names = list(start.states)
    return solve_space(
        [start.observed[name] for name in names],
        list(start.states.values()),
        np.array([_state_stddev(rig, name, start.observed[name]) for name in names]),
        earlier and earlier.express_in(start.states[rig.root].T_root_sensor),
        engine,
        lambda done: progress("solving", done),
    )


def _state_stddev(rig: Rig, name: str, observed: SpaceObservations) -> Array:
    """(12,) of the start of a sensor, in the order of :meth:`SensorState.moved`; times of beams are stated."""
    stated = _scanning_spec(name, rig.sensors[name]).uncertainty
    drift = stated.clock_drift if isinstance(stated, Lidar2dUncertainty) else _CLOCK_DRIFT
    pose = [*[_PLACE_STDDEV] * 3, *[_SLOPE_STDDEV] * 2, _ROTATION_STDDEV, _CLOCK_STDDEV]
    if observed.flat:
        roll, pitch, height = np.sqrt(np.diag(observed.floor_covariance))
        pose[2:5] = height, roll, pitch
    if name == rig.root:
        pose, drift = [0.0] * 7, 0.0
    return np.array([*pose, stated.range_bias, stated.range_scale, drift, *[0.0] * (TIMING - 1)])


def observe_clouds(
    splitter: CloudSplitter, spec: Lidar3dSpec, settings: TrackingSettings, rng: np.random.Generator
) -> SpaceObservations | Rejected:
    """The floor, static points and tracks that a stationary LiDAR measured, or why there are none.

    Args:
        splitter: that all its clouds were added to.
        spec: of the sensor, for the errors of its ranges.
        settings: of tracking.
        rng: of the search for the floor.
    """
    split = splitter.finish()
    if split is None:
        return Rejected("no cloud has any point")
    floor = find_floor(split.static, split.moving, spec.uncertainty.range_bias, spec.uncertainty.ring_bias, rng)
    if isinstance(floor, Rejected):
        return floor
    bodies = find_bodies(split.moving, floor.T_floor_sensor, split.view)
    tracks = track_bodies(bodies, floor.T_floor_sensor, settings)
    vehicles = find_vehicles(split.moving, floor.T_floor_sensor, settings)
    if not tracks and not vehicles:
        return Rejected(
            f"no person or vehicle could be tracked for {settings.motion.min_duration:g} s and "
            f"{settings.motion.min_travel:g} m in its sweeps: let people walk in its view"
        )
    return SpaceObservations(
        floor.T_floor_sensor, floor.covariance, split.static, floor.points, tracks, split.coverage, split.step,
        vehicles, untimed_sweep=split.untimed_sweep,
    )  # fmt: skip

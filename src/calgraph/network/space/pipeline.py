"""Networks in space: from one recording of people walking through a hall to the poses of its sensors."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.config import Cylinder, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array
from calgraph.network.checks.findings import collect_network_findings
from calgraph.network.options import NetworkOptions
from calgraph.network.space.assemble import SpaceResult, assemble_space
from calgraph.network.space.joint import SpaceSolution, solve_space
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.observe import observe_clouds
from calgraph.network.space.start import SpaceStart, start_in_space
from calgraph.network.space.static_directions import CloudSplitter
from calgraph.network.timed_tracks import track_with_beam_times
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.progress import Progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result import Calibration
from calgraph.result.finding import Finding
from calgraph.sensors import PointCloud
from calgraph.sensors.kinds import SensorSpec
from calgraph.surfaces.sensor_states import TIMING
from calgraph.verdict.state_changes import describe_changes

# Standard deviations of start poses, m and rad, and clocks, s: they are known to a tenth of that.
_PLACE_STDDEV, _ROTATION_STDDEV, _CLOCK_STDDEV = 1.0, 0.2, 0.1


def has_lidars(rig: Rig) -> bool:
    """Whether a network is one in space: it has a 3-D LiDAR."""
    return any(isinstance(spec, Lidar3dSpec) for spec in rig.sensors.values())


def check_space(rig: Rig, options: NetworkOptions) -> None:
    """Checks what is asked of a network in space.

    Raises:
        InputError: a sensor or the root is of another kind, the target is not people, or an option is of planar
            networks.
    """
    for name, spec in rig.sensors.items():
        _scanning_spec(name, spec)
    if not isinstance(rig.sensors[rig.root], Lidar3dSpec):
        raise InputError(
            f"root: must be a 3-D LiDAR, which measures the floor, where there is one, got {rig.root}"
        )
    if isinstance(rig.target, Cylinder):
        raise InputError("target.kind: must be people for a network of 3-D LiDARs, got cylinder")
    if options.extend is not None:
        raise InputError(
            "`extend`: is of networks of 2-D scanners alone as yet; give a recording of all sensors of the "
            "network, without it"
        )
    estimator = options.select_method(rig.settings.published).estimator
    if estimator != "joint":
        raise InputError(f"`estimator`: must be joint for a network of 3-D LiDARs, got {estimator}")


def calibrate_in_space(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    monitor: InputMonitor,
    findings: Sequence[Finding],
    progress: Progress,
) -> Calibration:
    """Calibrates stationary 3-D LiDARs, and 2-D scanners, from people who walk through their views.

    Args:
        rig: the network, which :func:`check_space` allows.
        recording: of its sensors, by one clock.
        options: how to calibrate.
        monitor: observes the messages.
        findings: of clocks.
        progress: called with the step and the fraction done.
    """
    observed, frames = _observe(rig, recording, options, monitor, progress)
    tracked, of_scanners, found = _track_scanners(rig, recording, options, monitor, progress)
    findings = [*findings, *monitor.findings(), *found]
    scanners = {name: one for name, one in tracked.items() if isinstance(one, ScannerTracks)}
    measured = {name: one for name, one in observed.items() if isinstance(one, SpaceObservations)}
    findings += _describe_steps(rig, measured, recording.start)
    rng = np.random.default_rng(options.seed)
    start = start_in_space(rig, measured, scanners, options, rng, progress)
    findings += start.corrected.findings
    findings += collect_network_findings(tracked, start.initialization, recording.start)
    solution = _solve(rig, start, progress) if len(start.states) > 1 else None
    if solution is not None:
        names = list(start.states)
        findings += describe_changes(solution.changes, names, rig.root, solution.begin)
    rejected = {name: one for name, one in (observed | tracked).items() if isinstance(one, Rejected)}
    result = SpaceResult(
        {name: rejected.get(name) or start.observed[name] for name in rig.sensors}, frames | of_scanners, start,
        recording.start, solution, findings,
    )  # fmt: skip
    return assemble_space(rig, result)


def _observe(
    rig: Rig, recording: Recording, options: NetworkOptions, monitor: InputMonitor, progress: Progress
) -> tuple[dict[str, SpaceObservations | Rejected], dict[str, str]]:
    """What each 3-D LiDAR measured, and the frames that messages state."""
    specs = {name: spec for name, spec in rig.sensors.items() if isinstance(spec, Lidar3dSpec)}
    names = {rig.topics[name]: name for name in specs}
    splitters = {name: CloudSplitter() for name in specs}
    frames: dict[str, str] = {}
    for record in monitor.observe(recording.records(list(names))):
        name, message = names[record.topic], record.decode()
        if isinstance(message, PointCloud):
            frames.setdefault(name, message.frame_id)
            splitters[name].add(message)
        progress("reading", (record.arrival - recording.start) / max(recording.end - recording.start, 1e-9))
    observed: dict[str, SpaceObservations | Rejected] = {}
    for k, (name, spec) in enumerate(specs.items()):
        rng = np.random.default_rng([options.seed, k])
        observed[name] = observe_clouds(splitters.pop(name), spec, rig.settings.tracking, rng)
        progress("tracking", (k + 1) / len(specs))
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


def _scanning_spec(name: str, spec: SensorSpec) -> Lidar2dSpec | Lidar3dSpec:
    if not isinstance(spec, Lidar2dSpec | Lidar3dSpec):
        raise InputError(
            f"sensors.{name}.kind: must be lidar3d or lidar2d beside 3-D LiDARs that people calibrate, got "
            f"{spec.kind}; give other sensors a separate rig.yaml"
        )
    return spec


def _describe_steps(rig: Rig, measured: Mapping[str, SpaceObservations], begin: float) -> list[Finding]:
    """A finding for each sensor that moved during the recording."""
    return [
        Finding(
            f"{name} moved {one.step.time - begin:.0f} s from the start, by {1000 * one.step.shift:.1f} mm and "
            f"{np.degrees(one.step.turn):.2f}° relative to what stands still: fix it firmly, and record again",
            tuple(measured) if name == rig.root else (name,),
        )
        for name, one in measured.items()
        if one.step is not None
    ]


def _solve(rig: Rig, start: SpaceStart, progress: Progress) -> SpaceSolution:
    names = list(start.states)
    return solve_space(
        [start.observed[name] for name in names],
        list(start.states.values()),
        np.array([_state_stddev(rig, name, start.observed[name]) for name in names]),
        lambda done: progress("solving", done),
    )


def _state_stddev(rig: Rig, name: str, observed: SpaceObservations) -> Array:
    """(12,) of the start of a sensor, in the order of :meth:`SensorState.moved`; times of beams are stated."""
    stated = _scanning_spec(name, rig.sensors[name]).uncertainty
    pose = [*[_PLACE_STDDEV] * 3, *[_ROTATION_STDDEV] * 3, _CLOCK_STDDEV]
    if observed.flat:
        roll, pitch, height = observed.floor_stddev
        pose[2:5] = height, roll, pitch
    return np.array(
        [*([0.0] * 7 if name == rig.root else pose), stated.range_bias, stated.range_scale, *[0.0] * TIMING]
    )

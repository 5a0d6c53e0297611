"""Tracking in a recording of a network's scanners, in batches that are read and tracked in parallel."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from calgraph.config import Cylinder, Lidar2dSpec, People, Rig, SensorSpec
from calgraph.config.settings import CenterFeature
from calgraph.errors import InputError, Rejected
from calgraph.network.graph.beam_times import recognize_beam_times
from calgraph.network.joint.legs import measures_legs
from calgraph.network.options import NetworkOptions
from calgraph.network.scanner_pairs import average_pairs, pair_scanners
from calgraph.network.tracking.features import CenterEstimator, measure_centroids
from calgraph.network.tracking.scan_stack import ScanRun, ScanStackBuilder, add_beam_times, find_untimed_scans
from calgraph.network.tracking.track import TRACK_TYPES, ScannerTracks
from calgraph.network.tracking.track_scanner import track_runs
from calgraph.parallel.engine import THIS_PROCESS
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.mapped_arrays import ArrayMemory
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording, RecordingReference, refer_to
from calgraph.recording.input_checks import InputMonitor, TopicObservations
from calgraph.result.finding import Finding
from calgraph.sensors.cloud_to_scan import to_scans
from calgraph.sensors.untimed_scans import describe_turning

_log = logging.getLogger("calgraph")

# Scans read together, exceeded only by those of one scanner: 0.4 GB of ranges of 1000 beams in single precision.
_MAX_SCANS_IN_MEMORY = 100_000
# A pass over the messages of others takes 0.5 % of the work on all of them: four batches for each worker cost
# little, and keep workers busy until the end.
_BATCHES_PER_WORKER = 4
# Fewer scans than these are tracked faster than other processes start.
_MIN_DIVIDED_SCANS = 1000
_TRACKS = "tracks/3"


@dataclass(frozen=True, eq=False)
class _Tracked:
    """What one pass over the messages of a scanner yields."""

    tracks: ScannerTracks | Rejected
    frame: str | None
    """That its first message states; None where it has none."""
    observations: TopicObservations


_KEPT_TYPES = (_Tracked, TopicObservations, *TRACK_TYPES)


def track_people(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    progress: Progress = no_progress,
    monitor: InputMonitor | None = None,
    turns: Mapping[str, int] = MappingProxyType({}),
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str]]:
    """The tracks of each scanner, and the frames that their messages state; a monitor observes the messages.

    What an earlier run tracked in a scanner is taken from the cache of the options. Scans without times of beams
    are taken to be of scanners that turn (1; -1 against the order of their beams) where ``turns`` states it.
    """
    moving_target(rig)
    for name, spec in rig.sensors.items():
        scanner_spec(name, spec)
    monitor = monitor or InputMonitor(rig, recording.start)
    inputs = {name: _list_inputs(name, rig, options, turns.get(name, 0)) for name in rig.sensors}
    memory = ArrayMemory(rig.settings.estimation.network.max_kept_bytes)
    found = {
        name: _limit_memory(kept, memory)
        for name, given in inputs.items()
        if (kept := options.cache.read(recording, _TRACKS, given, _KEPT_TYPES)) is not None
    }
    for name, kept in found.items():
        monitor.restore(rig.topics[name], kept.observations)
    recording.records(list(rig.topics.values()))  # refuses topics that do not fit together
    if found:
        options.cache.reused.update(found)
        _log.info("tracks of %s: from the cache", ", ".join(found))
    unread = [name for name in rig.sensors if name not in found]
    for tracked in _track_unread(rig, recording, unread, options, turns):
        for name, one in tracked.items():
            found[name] = _limit_memory(one, memory)
            monitor.restore(rig.topics[name], one.observations)
            options.cache.write(recording, _TRACKS, inputs[name], one)
        progress("tracking", len(found) / len(rig.sensors))
    tracks = {name: found[name].tracks for name in rig.sensors}
    for name, of_scanner in tracks.items():
        found_tracks = f"none, {of_scanner.reason}" if isinstance(of_scanner, Rejected) else len(of_scanner.tracks)
        _log.info("tracks of %s: %s", name, found_tracks)
    stated = {name: frame for name in rig.sensors if (frame := found[name].frame) is not None}
    return tracks, stated


def forget_unused_beams(
    rig: Rig, tracks: Mapping[str, ScannerTracks | Rejected]
) -> dict[str, ScannerTracks | Rejected]:
    """The tracks of all scanners without the beams beside them, which only measurements of legs need."""
    target, tracked = moving_target(rig), [one for one in tracks.values() if isinstance(one, ScannerTracks)]
    if isinstance(target, People) and measures_legs(target, tracked, rig.settings.estimation.network.legs):
        return dict(tracks)
    return {
        name: replace(one, foreground=None) if isinstance(one, ScannerTracks) else one
        for name, one in tracks.items()
    }


def _limit_memory(tracked: _Tracked, memory: ArrayMemory) -> _Tracked:
    """The same; beams that may be forgotten have a file for themselves."""
    if isinstance(tracked.tracks, Rejected):
        return tracked
    tracks = memory.limit(replace(tracked.tracks, foreground=None))
    return replace(tracked, tracks=replace(tracks, foreground=memory.limit(tracked.tracks.foreground)))


def _list_inputs(name: str, rig: Rig, options: NetworkOptions, turn: int) -> dict[str, Any]:
    """What the tracks of a scanner depend on, besides the recording."""
    return {
        "topic": rig.topics[name],
        "target": rig.target,
        "noise": rig.sensors[name].noise,
        "feature": options.select_method(rig.settings.published).feature,
        "settings": rig.settings.tracking,
        "turn": turn,
    }


def moving_target(rig: Rig) -> People | Cylinder:
    """The target of a network; raises InputError for a rig."""
    if not isinstance(rig.target, People | Cylinder):
        raise InputError("target.kind: a network needs people or cylinder")
    return rig.target


def scanner_spec(name: str, spec: SensorSpec) -> Lidar2dSpec:
    """The same for a scanner; raises InputError for any other sensor."""
    if not isinstance(spec, Lidar2dSpec):
        raise InputError(f"sensors.{name}.kind: only 2-D scanners (lidar2d) track people, got {spec.kind}")
    return spec


def _track_unread(
    rig: Rig, recording: Recording, names: Sequence[str], options: NetworkOptions, turns: Mapping[str, int]
) -> Iterator[dict[str, _Tracked]]:
    """What is tracked in some scanners, batch by batch in their order.

    Each call reads the recording by itself: its scanners' messages take a hundred times longer to decode and to
    track in than those of others take to pass over.
    """
    counts = {topic.name: topic.count for topic in recording.topics}
    scans = [counts.get(rig.topics[name], 0) for name in names]
    # A cluster may have lost all workers for a moment. One worker would only read the recording once for each
    # batch.
    engine, workers = options.engine, options.engine.workers
    batches = 1 if workers == 1 else _BATCHES_PER_WORKER * max(workers, 1)
    if sum(scans) < _MIN_DIVIDED_SCANS:
        engine, batches = THIS_PROCESS, 1
    limit = min(_MAX_SCANS_IN_MEMORY, -(-sum(scans) // batches))
    feature = options.select_method(rig.settings.published).feature
    shared = Kept.of((rig, refer_to(recording, rig.settings.limits), feature, dict(turns)))
    return engine.map(_track_batch, ((shared, batch) for batch in _divide(names, scans, limit)))


def _divide(names: Sequence[str], scans: Sequence[int], limit: int) -> Iterator[list[str]]:
    """Batches of scanners with at most ``limit`` scans together, unless one scanner has more."""
    batch: list[str] = []
    total = 0
    for name, count in zip(names, scans, strict=True):
        total += count
        if batch and total > limit:
            yield batch
            batch, total = [], count
        batch.append(name)
    if batch:
        yield batch


def _track_batch(
    shared: tuple[Rig, RecordingReference, CenterFeature, Mapping[str, int]], names: Sequence[str]
) -> dict[str, _Tracked]:
    """Reads the messages of some scanners, and tracks in each."""
    rig, reference, feature, turns = shared
    with reference.open() as recording:
        monitor = InputMonitor(rig, recording.start)
        scans, frames = _read_scans(recording, {rig.topics[name]: name for name in names}, monitor)
    target, centers = moving_target(rig), select_center_estimator(feature)
    tracked = {}
    for name in names:
        noise = scanner_spec(name, rig.sensors[name]).noise
        runs = scans.pop(name)
        untimed = find_untimed_scans(runs)
        if untimed and name in turns:
            runs, untimed = add_beam_times(runs, untimed, turns[name]), None
        tracks = track_runs(runs, target, noise, centers, rig.settings.tracking)
        if isinstance(tracks, ScannerTracks):
            tracks = replace(tracks, untimed=untimed)
        tracked[name] = _Tracked(tracks, frames.get(name), monitor.observations(rig.topics[name]))
    return tracked


def _read_scans(
    recording: Recording, names: Mapping[str, str], monitor: InputMonitor
) -> tuple[dict[str, tuple[ScanRun, ...]], dict[str, str]]:
    """The scans of some scanners, given by topic, and the frames they state."""
    gathered = {name: ScanStackBuilder() for name in names.values()}
    frames: dict[str, str] = {}
    for record in monitor.observe(recording.records(list(names))):
        name = names[record.topic]
        for scan in to_scans([record.decode()]):
            frames.setdefault(name, scan.frame_id)
            gathered[name].add(scan)
    return {name: gathered.pop(name).runs() for name in names.values()}, frames


# Displacement of people within a scan below which times of beams do not matter, m: clocks take the mean of it, and
# what is left is half of it at most, the error that a pose may have by default.
_MAX_DISPLACEMENT = 0.02
# At which people walk, m/s.
_WALKING_SPEED = 1.4


def track_with_beam_times(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    progress: Progress = no_progress,
    monitor: InputMonitor | None = None,
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str], tuple[Finding, ...]]:
    """Tracks and frames as of :func:`track_people`, and what was found about the times of beams.

    Scanners whose ``time_increment`` is zero although they turn are tracked again with the times of their beams.
    """
    tracks, frames = track_people(rig, recording, options, progress, monitor)
    tracked = {name: one for name, one in tracks.items() if isinstance(one, ScannerTracks)}
    untimed = {name: one.untimed for name, one in tracked.items() if one.untimed is not None}
    if not untimed:
        return tracks, frames, ()
    rng = np.random.default_rng(options.seed)
    corrected = pair_scanners(rig, tracked, options, rng, no_progress)
    start = average_pairs(rig, corrected, options.select_method(rig.settings.published), rng)
    turns = recognize_beam_times(corrected.tracked, start, corrected.inverted)
    findings: list[Finding] = []
    if turning := [name for name in untimed if turns.get(name)]:
        tracks, frames = track_people(rig, recording, options, progress, None, turns)
        periods = [untimed[name].period for name in turning]
        findings.append(Finding(describe_turning(turning, periods, "people are")))
    unknown = [name for name in untimed if name not in turns and _displacement(tracked[name]) > _MAX_DISPLACEMENT]
    if unknown:
        most = max(_displacement(tracked[name]) for name in unknown)
        findings.append(
            Finding(
                f"the scans of {', '.join(unknown)} have no times of beams (time_increment is 0), and the tracks "
                "do not show whether all are simultaneous: if not, people are displaced by up to "
                f"{1e3 * most:.0f} mm; set time_increment in the drivers, or let people walk longer where views "
                "overlap",
                tuple(unknown),
            )
        )
    return tracks, frames, tuple(findings)


def _displacement(tracked: ScannerTracks) -> float:
    """By which people move while a scanner turns through the bearings that it measured them at, m."""
    scans = tracked.untimed
    positions = [track.positions for track in tracked.tracks]
    if scans is None or not positions:
        return 0.0
    x = np.concatenate(positions)
    times = scans.turn_times(np.arctan2(x[:, 1], x[:, 0]))
    return _WALKING_SPEED * float(np.ptp(times))


def select_center_estimator(feature: CenterFeature) -> CenterEstimator | None:
    """The estimator of the centres of tracked objects; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            return measure_centroids
        case "ellipse":
            from calgraph.network.published.direct_ellipses import measure_direct_ellipses

            return measure_direct_ellipses

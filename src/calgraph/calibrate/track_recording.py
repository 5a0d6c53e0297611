"""Tracking in a recording of a network's scanners: read once, tracked in parallel."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calgraph.calibrate.options import NetworkOptions, Progress, no_progress
from calgraph.calibrate.step_log import log_tracks
from calgraph.calibrate.strategies import select_center_estimator
from calgraph.captures import InputMonitor, to_scans
from calgraph.captures.input_checks import TopicObservations, decode_observations, encode_observations
from calgraph.config import Cylinder, Lidar2dSpec, People, Rig, SensorSpec
from calgraph.errors import InputError, Rejected
from calgraph.io.columns import Arrays
from calgraph.recording import Recording
from calgraph.tracking import (
    ScannerTracks,
    ScanRun,
    ScanStackBuilder,
    decode_tracks,
    encode_tracks,
    track_scanners,
)

_log = logging.getLogger("calgraph")

# Scans held in memory together, exceeded only by those of one scanner: 0.8 GB for scans of 1000 beams.
_MAX_SCANS_IN_MEMORY = 100_000
_TRACKS = "tracks/1"


@dataclass(frozen=True, eq=False)
class _Tracked:
    """What one pass over the messages of a scanner yields."""

    tracks: ScannerTracks | Rejected
    frame: str | None
    """That its first message states; None where it has none."""
    observations: TopicObservations


def track_people(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    progress: Progress = no_progress,
    monitor: InputMonitor | None = None,
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str]]:
    """The tracks of each scanner, and the frames that their messages state; a monitor observes the messages.

    What an earlier run tracked in a scanner is taken from the cache of the options.
    """
    target = moving_target(rig)
    noise = {name: scanner_spec(name, spec).noise for name, spec in rig.sensors.items()}
    monitor = monitor or InputMonitor(rig, recording.start)
    inputs = {name: _list_inputs(name, rig, options) for name in rig.sensors}
    found = {
        name: kept
        for name, given in inputs.items()
        if (kept := options.cache.read(recording, _TRACKS, given, _decode)) is not None
    }
    for name, kept in found.items():
        monitor.restore(rig.topics[name], kept.observations)
    if found:
        recording.records(list(rig.topics.values()))  # refuses topics that do not fit together
        options.cache.reused.update(found)
        _log.info("tracks of %s: from the cache", ", ".join(found))
    unread = [name for name in rig.sensors if name not in found]
    for names in _memory_batches(unread, rig, recording):

        def tracking(share: float, before: int = len(found), count: int = len(names)) -> None:
            progress("tracking", (before + share * count) / len(rig.sensors))

        scans, frames = _read_scans(recording, {rig.topics[name]: name for name in names}, monitor, progress)
        tracks = track_scanners(
            scans,
            target,
            noise,
            centers=select_center_estimator(options.feature, rig.settings.baselines),
            settings=rig.settings.tracking,
            engine=options.engine,
            progress=tracking,
        )
        for name in names:
            observations = monitor.observations(rig.topics[name])
            found[name] = _Tracked(tracks[name], frames.get(name), observations)
            options.cache.write(recording, _TRACKS, inputs[name], *_encode(found[name]))
    tracks = {name: found[name].tracks for name in rig.sensors}
    log_tracks(tracks)
    stated = {name: frame for name in rig.sensors if (frame := found[name].frame) is not None}
    return tracks, stated


def _list_inputs(name: str, rig: Rig, options: NetworkOptions) -> dict[str, Any]:
    """What the tracks of a scanner depend on, besides the recording."""
    return {
        "topic": rig.topics[name],
        "target": rig.target,
        "noise": rig.sensors[name].noise,
        "feature": options.feature,
        "baselines": rig.settings.baselines,
        "settings": rig.settings.tracking,
    }


def _encode(tracked: _Tracked) -> tuple[dict[str, Any], Arrays]:
    content, arrays = encode_observations(tracked.observations)
    of_tracks, columns = encode_tracks(tracked.tracks)
    return {**content, **of_tracks, "frame": tracked.frame}, {**arrays, **columns}


def _decode(content: Mapping[str, Any], arrays: Arrays) -> _Tracked:
    return _Tracked(decode_tracks(content, arrays), content["frame"], decode_observations(content, arrays))


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


def _memory_batches(names: Sequence[str], rig: Rig, recording: Recording) -> Iterator[Sequence[str]]:
    """Names of the scanners that are read together, so that their scans fit into memory."""
    counts = {topic.name: topic.count for topic in recording.topics}
    batch: list[str] = []
    scans = 0
    for name in names:
        count = counts.get(rig.topics[name], 0)
        scans += count
        if batch and scans > _MAX_SCANS_IN_MEMORY:
            yield batch
            batch, scans = [], count
        batch.append(name)
    if batch:
        yield batch


def _read_scans(
    recording: Recording, names: Mapping[str, str], monitor: InputMonitor, progress: Progress
) -> tuple[dict[str, tuple[ScanRun, ...]], dict[str, str]]:
    """The scans of some scanners, given by topic, and the frames they state."""
    gathered = {name: ScanStackBuilder() for name in names.values()}
    frames: dict[str, str] = {}
    length = max(recording.end - recording.start, 1e-9)
    for record in monitor.observe(recording.records(list(names))):
        name = names[record.topic]
        for scan in to_scans([record.decode()]):
            frames.setdefault(name, scan.frame_id)
            gathered[name].add(scan)
        progress("reading", (record.arrival - recording.start) / length)
    return {name: stack.runs() for name, stack in gathered.items()}, frames

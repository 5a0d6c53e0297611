"""Tracking in a recording of a network's scanners: read once, tracked in parallel."""

from collections.abc import Iterator, Mapping, Sequence

from calgraph.calibrate.options import NetworkOptions, Progress, no_progress
from calgraph.calibrate.step_log import log_tracks
from calgraph.calibrate.strategies import select_center_estimator
from calgraph.captures import InputMonitor, to_scans
from calgraph.config import Cylinder, Lidar2dSpec, People, Rig, SensorSpec
from calgraph.errors import InputError, Rejected
from calgraph.recording import Recording
from calgraph.tracking import ScannerTracks, ScanRun, ScanStackBuilder, track_scanners

# Scans held in memory together, exceeded only by those of one scanner: 0.8 GB for scans of 1000 beams.
_MAX_SCANS_IN_MEMORY = 100_000


def track_people(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    progress: Progress = no_progress,
    monitor: InputMonitor | None = None,
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str]]:
    """The tracks of each scanner, and the frames that their messages state; a monitor observes the messages."""
    target = moving_target(rig)
    noise = {name: scanner_spec(name, spec).noise for name, spec in rig.sensors.items()}
    tracks: dict[str, ScannerTracks | Rejected] = {}
    frames: dict[str, str] = {}
    for names in _memory_batches(rig, recording):

        def tracking(share: float, before: int = len(tracks), count: int = len(names)) -> None:
            progress("tracking", (before + share * count) / len(rig.sensors))

        scans, stated = _read_scans(recording, {rig.topics[name]: name for name in names}, monitor, progress)
        frames |= stated
        tracks |= track_scanners(
            scans,
            target,
            noise,
            centers=select_center_estimator(options.feature, rig.settings.baselines),
            settings=rig.settings.tracking,
            jobs=options.jobs,
            progress=tracking,
        )
    log_tracks(tracks)
    return tracks, frames


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


def _memory_batches(rig: Rig, recording: Recording) -> Iterator[Sequence[str]]:
    """Names of the scanners that are read together, so that their scans fit into memory."""
    counts = {topic.name: topic.count for topic in recording.topics}
    batch: list[str] = []
    scans = 0
    for name, topic in rig.topics.items():
        scans += counts.get(topic, 0)
        if batch and scans > _MAX_SCANS_IN_MEMORY:
            yield batch
            batch, scans = [], counts.get(topic, 0)
        batch.append(name)
    yield batch


def _read_scans(
    recording: Recording, names: Mapping[str, str], monitor: InputMonitor | None, progress: Progress
) -> tuple[dict[str, tuple[ScanRun, ...]], dict[str, str]]:
    """The scans of some scanners, given by topic, and the frames they state."""
    gathered = {name: ScanStackBuilder() for name in names.values()}
    frames: dict[str, str] = {}
    length = max(recording.end - recording.start, 1e-9)
    records = recording.records(list(names))
    for record in monitor.observe(records) if monitor else records:
        name = names[record.topic]
        for scan in to_scans([record.decode()]):
            frames.setdefault(name, scan.frame_id)
            gathered[name].add(scan)
        progress("reading", (record.arrival - recording.start) / length)
    return {name: stack.runs() for name, stack in gathered.items()}, frames

"""Captures of a rig: when the board rests in a recording, and what every sensor detects of it then."""

from collections.abc import Iterable

import numpy as np

from calgraph.calibrate.options import Progress, RigOptions, no_progress
from calgraph.calibrate.strategies import select_plane_estimator
from calgraph.captures import (
    ActivityMeter,
    CaptureSet,
    InputMonitor,
    RecordingTimeline,
    build_timeline,
    check_background,
    check_intrinsics,
    check_timeline,
    collect_detections,
    detect_in_holds,
    find_holds,
    is_snapshot_recording,
    learn_backgrounds,
    limit_messages,
    make_detectors,
    plan_previews,
)
from calgraph.config import CameraSpec, Rig
from calgraph.errors import CalibrationError
from calgraph.recording import Recording, find_camera_infos, resolve_intrinsics
from calgraph.sensors import RecordedMessage


def collect_captures(
    rig: Rig, recording: Recording, options: RigOptions, rng: np.random.Generator, progress: Progress = no_progress
) -> CaptureSet:
    """Finds the holds of the board, and detects the board in every sensor's messages of each hold."""
    if len(rig.sensors) < 2:
        raise CalibrationError(f"{rig.root} is the only sensor: a rig.yaml needs at least two")
    cameras = resolve_intrinsics(rig, recording).camera_models()
    monitor = InputMonitor(rig, recording.start, find_camera_infos(rig, recording))
    timeline = _read_timeline(rig, recording, monitor, progress)
    check_timeline(rig, timeline, recording.end)
    holds = limit_messages(find_holds(timeline, rig.capture, rig.settings.captures), rig)
    backgrounds = learn_backgrounds(_background_records(rig, recording), rig)
    detect = make_detectors(rig, cameras, backgrounds, select_plane_estimator(options.tags), rng)

    def detecting(done: float) -> None:
        progress("detecting", done / (len(holds) * len(rig.sensors)))

    observations = detect_in_holds(
        recording.records(rig.topics.values()), holds, rig.topics, detect,
        preview_sizes=plan_previews(holds, rig), jobs=options.jobs, progress=detecting,
    )  # fmt: skip
    findings = [
        *monitor.findings(),
        *check_intrinsics(cameras, rig.settings.captures.input_checks),
        *check_background(rig, timeline),
    ]
    return collect_detections(rig, timeline, holds, observations, cameras, findings)


def _read_timeline(rig: Rig, recording: Recording, monitor: InputMonitor, progress: Progress) -> RecordingTimeline:
    """The stamps of every sensor's messages and, without a trigger, how much its view changed at each."""
    trigger = rig.capture.trigger
    topics = [*rig.topics.values(), *([trigger] if trigger else [])]

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    records = monitor.observe(recording.records([*topics, *monitor.camera_info_topics]))
    timeline = build_timeline(records, recording.start, rig.topics, trigger, progress=reading)
    if trigger or is_snapshot_recording(timeline, rig.settings.captures.max_snapshot_gap):
        return timeline
    meters = {name: ActivityMeter(rig.settings.captures.motion) for name in rig.sensors}
    return build_timeline(
        recording.records(topics), recording.start, rig.topics, None, meters=meters, progress=reading
    )


def _background_records(rig: Rig, recording: Recording) -> Iterable[RecordedMessage]:
    """What the scanners measured without target and operator."""
    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    return recording.records(scanners, *(recording.start + t for t in window)) if window else ()

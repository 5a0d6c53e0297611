"""Captures of a rig: when the board rests in a recording, and what every sensor detects of it then."""

from functools import partial

import numpy as np

from calgraph.calibrate.options import Progress, RigOptions, no_progress
from calgraph.calibrate.strategies import select_plane_estimator
from calgraph.captures import (
    CaptureSet,
    DetectionMethod,
    InputMonitor,
    RecordingTimeline,
    check_background,
    check_intrinsics,
    check_timeline,
    collect_detections,
    compensate_motion,
    detect_by_sensors,
    draw_seeds,
    find_holds,
    is_snapshot_recording,
    limit_messages,
    measure_activity,
    read_timeline,
    recognize_mode,
)
from calgraph.config import Rig
from calgraph.errors import CalibrationError
from calgraph.recording import Recording, RecordingCache, find_camera_infos, resolve_intrinsics


def collect_captures(
    rig: Rig, recording: Recording, options: RigOptions, rng: np.random.Generator, progress: Progress = no_progress
) -> CaptureSet:
    """Finds the holds of the board, and detects the board in every sensor's messages of each hold."""
    if len(rig.sensors) < 2:
        raise CalibrationError(f"{rig.root} is the only sensor: a rig.yaml needs at least two")
    cameras = resolve_intrinsics(rig, recording).camera_models()
    monitor = InputMonitor(rig, recording.start, find_camera_infos(rig, recording))
    timeline = _read_timeline(rig, recording, monitor, options.cache, progress)
    check_timeline(rig, timeline, recording.end)
    holds = limit_messages(find_holds(timeline, rig.capture, rig.settings.captures), rig)
    plane_estimator = select_plane_estimator(options.tags)
    observations = detect_by_sensors(
        rig, recording, holds, DetectionMethod(cameras, draw_seeds(rig, rng), options.tags, plane_estimator),
        cache=options.cache, jobs=options.jobs, progress=partial(progress, "detecting"),
    )  # fmt: skip
    findings = [
        *monitor.findings(),
        *check_intrinsics(cameras, rig.settings.captures.input_checks),
        *check_background(rig, timeline),
    ]
    captures = collect_detections(rig, timeline, holds, observations, cameras, findings)
    if recognize_mode(timeline, rig.capture, rig.settings.captures).mode != "synchronized":
        return captures
    return compensate_motion(captures, rig.settings.captures.moving_board)


def _read_timeline(
    rig: Rig, recording: Recording, monitor: InputMonitor, cache: RecordingCache, progress: Progress
) -> RecordingTimeline:
    """The stamps of every sensor's messages and, without a trigger, how much its view changed at each."""

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = read_timeline(rig, recording, monitor, cache, reading)
    if rig.capture.trigger or is_snapshot_recording(timeline, rig.settings.captures.max_snapshot_gap):
        return timeline
    return measure_activity(timeline, rig, recording, cache, reading)

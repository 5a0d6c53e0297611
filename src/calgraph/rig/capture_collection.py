"""Captures of a rig: when the board rests in a recording, and what every sensor detects of it then."""

import logging
from dataclasses import replace
from functools import partial

import numpy as np

from calgraph.boards.camera import PlaneEstimator
from calgraph.config import Rig
from calgraph.config.settings import PlaneMethod
from calgraph.errors import CalibrationError
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording, find_camera_infos, resolve_intrinsics, separate_poses
from calgraph.recording.clocks import UNKNOWN_CLOCKS, Clocks
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.rig.beam_times import compensate_with_beam_times, find_untimed_scanners
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.clock_alignment import align_views, need_activity
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.detectors import draw_seeds
from calgraph.rig.captures.holds import find_holds, limit_messages
from calgraph.rig.captures.sensor_detection import DetectionMethod, detect_by_sensors
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.rig.captures.timeline_reading import read_rig_timeline
from calgraph.rig.captures.validate_recording import (
    check_background,
    check_intrinsics,
    check_pose_numbers,
    check_timeline,
)
from calgraph.rig.intrinsics.pipeline import estimate_unknown_intrinsics, find_intrinsics_remarks
from calgraph.rig.options import RigOptions

_log = logging.getLogger("calgraph")


# Minimum number of rests in which two sensors detect the board, below which, and below half of the rests, the
# views rest because the board is out of them, if stamps show sets of frames: fewer calibrate no pair of sensors.
_MIN_SHARED_RESTS = 5


def collect_captures(
    rig: Rig,
    recording: Recording,
    options: RigOptions,
    rng: np.random.Generator,
    progress: Progress = no_progress,
    clocks: Clocks = UNKNOWN_CLOCKS,
) -> CaptureSet:
    """Finds the holds of the board, and detects the board in every sensor's messages of each hold.

    The intrinsics of cameras without any are estimated first, from the same holds. Where the board is out of the
    views while they rest, and stamps show sets of frames, the captures are these.

    Args:
        rig: the rig.
        recording: whose stamps are corrected by arrivals.
        options: how to calibrate.
        rng: for what is drawn at random.
        progress: called with the step and the fraction done.
        clocks: what arrivals show of clocks.
    """
    if len(rig.sensors) < 2:
        raise CalibrationError(f"{rig.root} is the only sensor: a rig.yaml needs at least two")
    monitor = InputMonitor(rig, recording.start, find_camera_infos(rig, recording))
    timeline = read_rig_timeline(
        rig, recording, monitor, options.cache, options.engine, progress, active=need_activity(rig, clocks)
    )
    recording, timeline, findings = align_views(rig, recording, timeline, clocks)
    check_pose_numbers(rig, timeline, recording.topics)
    check_timeline(rig, timeline, recording.end)
    captures = _detect_in_timeline(rig, recording, timeline, options, rng, progress)
    recognized = recognize_mode(timeline, rig.capture, rig.settings.captures)
    shared = captures.count_shared()
    out_of_view = shared < min(_MIN_SHARED_RESTS, len(captures.holds) / 2)
    if out_of_view and recognized.mode == "rest" and recognized.spread is not None:
        rests = len(captures.holds)
        moving = rig.capture.model_copy(update={"mode": "synchronized"})
        rig = rig.model_copy(update={"capture": moving})
        captures = _detect_in_timeline(rig, recording, timeline, options, rng, progress)
        finding = Finding(
            f"two sensors detect the board in {shared} of {rests} rests of their views: the captures are sets "
            "of frames, in which it moves; if it was meant to rest, hold it still where two sensors detect it"
        )
        captures = replace(captures, findings=(*captures.findings, finding))
    return replace(captures, findings=(*monitor.findings(), *findings, *captures.findings))


def correct_late_views(
    rig: Rig, recording: Recording, options: RigOptions, clocks: Clocks
) -> tuple[Recording, list[Finding]]:
    """The recording with the stamps of late sensors corrected, from when the board rests in all views.

    After a trigger, a sensor whose stamps and arrivals are late has measured the end of the move before it.
    """
    untriggered = rig.model_copy(
        update={"capture": rig.capture.model_copy(update={"trigger": None, "mode": "rest"})}
    )
    monitor = InputMonitor(rig, recording.start, {})
    timeline = read_rig_timeline(untriggered, recording, monitor, options.cache, options.engine, no_progress)
    corrected, _, findings = align_views(untriggered, recording, timeline, clocks)
    return corrected, findings


def _detect_in_timeline(
    rig: Rig,
    recording: Recording,
    timeline: RecordingTimeline,
    options: RigOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> CaptureSet:
    """The detections in the holds of a timeline, and what the holds show of the rig."""
    resolved, camera_infos = resolve_intrinsics(rig, recording), find_camera_infos(rig, recording)
    holds = limit_messages(find_holds(timeline, rig.capture, rig.settings.captures), rig)
    intrinsics = estimate_unknown_intrinsics(
        resolved, recording, timeline, holds, options.engine, progress, options.cache
    )
    cameras = resolved.camera_models() | {name: one.camera for name, one in intrinsics.estimates.items()}
    tags = options.select_method(rig.settings.published).tags
    method = DetectionMethod(cameras, draw_seeds(rig, rng), intrinsics.marks, tags, _select_plane_estimator(tags))
    usable = {name: spec for name, spec in rig.sensors.items() if name not in intrinsics.failed}
    observations = detect_by_sensors(
        rig.model_copy(update={"sensors": usable}), recording, timeline, holds, method,
        cache=options.cache, engine=options.engine, progress=partial(progress, "detecting"),
    )  # fmt: skip
    observations += [
        SensorCapture(hold.index, name, reason) for name, reason in intrinsics.failed.items() for hold in holds
    ]
    findings = [
        *check_intrinsics(cameras),
        *check_background(rig, timeline),
        *find_intrinsics_remarks(rig, camera_infos, intrinsics),
    ]
    captures = replace(
        collect_detections(rig, timeline, holds, observations, cameras, findings),
        estimated_intrinsics={name: one.to_intrinsics() for name, one in intrinsics.estimates.items()},
    )
    recognized = recognize_mode(timeline, rig.capture, rig.settings.captures)
    _log.info("captures by mode %s: %s", recognized.mode, recognized.reason)
    if recognized.mode != "synchronized":
        return captures
    untimed = find_untimed_scanners(rig, recording, timeline)
    return compensate_with_beam_times(rig, captures, untimed, np.random.default_rng(options.seed))


def separate_snapshots(rig: Rig, recording: Recording) -> Recording:
    """The recording, as recordings of one pose each where several short ones were given."""
    settings = rig.settings.captures
    if rig.capture.trigger or rig.capture.mode in ("rest", "synchronized"):
        return recording
    return separate_poses(
        recording,
        list(rig.topics.values()),
        stated=rig.capture.mode == "snapshots",
        max_duration=settings.max_pose_recording,
        gap=settings.max_snapshot_gap,
    )


def _select_plane_estimator(method: PlaneMethod) -> PlaneEstimator | None:
    """The estimator of a board's plane from its tags; None for one PnP over all corners."""
    if method == "pnp":
        return None
    from calgraph.rig.published.mean_plane import estimate_mean_plane

    return estimate_mean_plane

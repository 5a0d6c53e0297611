"""Holds: the times in which the board rests; the messages measured in them, and the detections of the board."""

from calgraph.captures.board_views import find_views_in_holds
from calgraph.captures.capture_mode import RecognizedMode, is_snapshot_recording, recognize_mode
from calgraph.captures.clock_alignment import ClockOffset, check_clocks, estimate_clock_offsets
from calgraph.captures.detect import (
    CaptureSet,
    Detector,
    SensorCapture,
    collect_detections,
    detect_in_holds,
    limit_messages,
    state_estimated_intrinsics,
)
from calgraph.captures.detectors import (
    draw_seeds,
    learn_backgrounds,
    learn_backgrounds_of_captures,
    make_detectors,
    to_scans,
)
from calgraph.captures.empty_start import EmptyStart, find_empty_start, resolve_background
from calgraph.captures.from_detections import GivenDetections, captures_from_detections
from calgraph.captures.holds import Hold, find_holds
from calgraph.captures.input_checks import InputFinding, InputMonitor
from calgraph.captures.motion_detection import ActivityMeter
from calgraph.captures.moving_board import compensate_motion
from calgraph.captures.plausibility import check_background, check_intrinsics
from calgraph.captures.previews import PreviewSize, plan_previews
from calgraph.captures.recognized_recording import recognize_recording
from calgraph.captures.sensor_detection import DetectionMethod, detect_by_sensors
from calgraph.captures.timeline import RecordingTimeline, SensorTimes, build_timeline
from calgraph.captures.timeline_reading import measure_activity, read_timeline
from calgraph.captures.validate_recording import check_pose_numbers, check_timeline

__all__ = [
    "ActivityMeter", "CaptureSet", "ClockOffset", "DetectionMethod", "Detector", "EmptyStart",
    "GivenDetections", "Hold", "InputFinding", "InputMonitor", "PreviewSize", "RecognizedMode",
    "RecordingTimeline", "SensorCapture", "SensorTimes", "build_timeline", "captures_from_detections",
    "check_background", "check_clocks", "check_intrinsics", "check_pose_numbers", "check_timeline",
    "collect_detections", "compensate_motion", "detect_by_sensors", "detect_in_holds", "draw_seeds",
    "estimate_clock_offsets", "find_empty_start", "find_holds", "find_views_in_holds", "is_snapshot_recording",
    "learn_backgrounds", "learn_backgrounds_of_captures", "limit_messages", "make_detectors",
    "measure_activity", "plan_previews", "read_timeline", "recognize_mode", "recognize_recording",
    "resolve_background", "state_estimated_intrinsics", "to_scans",
]  # fmt: skip

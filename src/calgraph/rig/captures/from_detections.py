"""Captures from detections that were made outside calgraph, without a recording."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.boards.detections import Detection, DetectionResult
from calgraph.config import Rig
from calgraph.errors import InputError, Rejected
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.moving_board import compensate_motion
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.kinds import RIG_KINDS
from calgraph.sensors import CameraModel

GivenDetections = Detection | Sequence[Detection] | Rejected
"""Of one sensor in one capture: the board, several candidates of which one is the board, or why there is none."""


def captures_from_detections(
    rig: Rig,
    detections: Mapping[str, Mapping[int, GivenDetections]],
    cameras: Mapping[str, CameraModel] | None = None,
    stamps: Mapping[str, Mapping[int, float]] | None = None,
) -> CaptureSet:
    """Builds the captures of a rig from detections made outside calgraph.

    Args:
        rig: sensors and board. Topics do not matter.
        detections: by sensor, and by capture: all sensors' detections under one number are of the same resting
            board, or of a moving board at nearly the same time.
        cameras: intrinsics by camera; those of the rig if left out.
        stamps: of a moving board, by sensor and capture, when each sensor measured it, s. Captures follow each
            other within fractions of a second: the sensor's own detections before and after show the motion.

    Raises:
        InputError: a sensor is not the rig's, a detection does not fit the sensor's kind, or a camera has no
                intrinsics.
    """
    cameras = rig.camera_models() if cameras is None else cameras
    missing = set(rig.cameras()) - set(cameras)
    if missing:
        raise InputError(f"cameras: lacks {', '.join(sorted(missing))}")
    unknown = set(detections) - set(rig.sensors)
    if unknown:
        raise InputError(f"detections: must be of {', '.join(rig.sensors)}, got {', '.join(sorted(unknown))}")
    captures = sorted({capture for by_capture in detections.values() for capture in by_capture})
    sensor_captures = [
        SensorCapture(capture, name, _to_candidates(rig, name, capture, detections.get(name, {}).get(capture)))
        for capture in captures
        for name in rig.sensors
    ]
    no_times = np.zeros(0)
    times = {name: SensorTimes(no_times, 0.0, no_times, spec.frame_id or "") for name, spec in rig.sensors.items()}
    holds = [Hold(capture, 0.0, 0.0) if stamps is None else _hold_of(capture, stamps) for capture in captures]
    found = collect_detections(rig, RecordingTimeline(0.0, times, no_times), holds, sensor_captures, cameras)
    return found if stamps is None else compensate_motion(found, rig.settings.captures.moving_board)


def _hold_of(capture: int, stamps: Mapping[str, Mapping[int, float]]) -> Hold:
    measured = {name: np.array([of[capture]]) for name, of in stamps.items() if capture in of}
    if not measured:
        raise InputError(f"stamps: must have one of a sensor for every capture, has none of capture {capture}")
    values = [float(one[0]) for one in measured.values()]
    return Hold(capture, min(values), max(values), measured)


def _to_candidates(rig: Rig, name: str, capture: int, result: GivenDetections | None) -> DetectionResult:
    if result is None:
        return Rejected("no detection was given")
    if isinstance(result, Rejected):
        return result
    candidates = (result,) if isinstance(result, Detection) else tuple(result)
    kind = rig.sensors[name].kind
    detected = RIG_KINDS[kind].detection
    for detection in candidates:
        if not isinstance(detection, detected):
            raise InputError(
                f"detections: {name} is a {kind} and detects {detected.__name__}, got "
                f"{type(detection).__name__} in capture {capture}"
            )
    return candidates or Rejected("no detection was given")

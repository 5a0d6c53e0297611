"""Captures whose detections somebody else made, instead of a recording that they are found in."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.captures.detect import Captured, Observation, gather
from calgraph.captures.holds import Hold
from calgraph.captures.timeline import SensorTimes, Timeline
from calgraph.config import Rig
from calgraph.detection import BoardCorners, Detection, PlanePatch, Segment
from calgraph.errors import InputError, Rejected
from calgraph.sensors import CameraModel

Found = Detection | Sequence[Detection] | Rejected
"""What a sensor saw in a capture: the board, several things of which one is the board, or nothing, and why."""

_SEEN_BY = {"camera": BoardCorners, "lidar2d": Segment, "lidar3d": PlanePatch}


def captured_from(
    rig: Rig,
    found: Mapping[str, Mapping[int, Found]],
    cameras: Mapping[str, CameraModel] | None = None,
) -> Captured:
    """What the sensors of a rig saw, from detections made elsewhere.

    Args:
        rig: sensors and board. Topics do not matter.
        found: by sensor, and by capture: all sensors' detections under one number are of the same resting board.
        cameras: intrinsics by camera; those of the rig if left out.

    Raises:
        InputError: a sensor is not the rig's, or sees what its kind cannot see, or a camera has no intrinsics.
    """
    cameras = _cameras(rig) if cameras is None else cameras
    lacking = set(rig.cameras()) - set(cameras)
    if lacking:
        raise InputError(f"cameras: lacks {', '.join(sorted(lacking))}")
    unknown = set(found) - set(rig.sensors)
    if unknown:
        raise InputError(f"found: must be of {', '.join(rig.sensors)}, got {', '.join(sorted(unknown))}")
    captures = sorted({capture for by_capture in found.values() for capture in by_capture})
    observations = [
        Observation(capture, name, _candidates(rig, name, capture, found.get(name, {}).get(capture)))
        for capture in captures
        for name in rig.sensors
    ]
    never = np.zeros(0)
    times = {name: SensorTimes(never, 0.0, never, spec.frame_id or "") for name, spec in rig.sensors.items()}
    holds = [Hold(capture, 0.0, 0.0) for capture in captures]
    return gather(rig, Timeline(0.0, times, never), holds, observations, cameras)


def _candidates(rig: Rig, name: str, capture: int, found: Found | None) -> tuple[Detection, ...] | Rejected:
    if found is None:
        return Rejected("no detection was given")
    if isinstance(found, Rejected):
        return found
    candidates = (found,) if isinstance(found, Detection) else tuple(found)
    kind = rig.sensors[name].kind
    for detection in candidates:
        if not isinstance(detection, _SEEN_BY[kind]):
            raise InputError(
                f"found: {name} is a {kind} and sees {_SEEN_BY[kind].__name__}, got {type(detection).__name__} "
                f"in capture {capture}"
            )
    return candidates or Rejected("no detection was given")


def _cameras(rig: Rig) -> Mapping[str, CameraModel]:
    """Intrinsics that the rig states."""
    return {name: spec.intrinsics.camera() for name, spec in rig.cameras().items() if spec.intrinsics}

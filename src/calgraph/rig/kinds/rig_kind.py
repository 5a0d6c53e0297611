"""What the wing needs to know of a kind of sensor: how it detects the board, and how its view changes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.camera import PlaneEstimator
from calgraph.boards.detections import BoardCorners, DetectionResult, PlanePatch, Segment
from calgraph.config import Rig
from calgraph.config.settings import DetectionSettings, MaxMessageSettings
from calgraph.rig.detection.capture_background import CaptureBackground
from calgraph.rig.detection.cloud_background import CloudBackground
from calgraph.sensors import CameraModel, Measurement, Message, ScanBackground

Detector = Callable[[Sequence[Any]], DetectionResult]
"""Finds the board in the messages that one sensor sent during one hold."""
Background = CloudBackground | CaptureBackground | ScanBackground
Signature = NDArray[np.float64] | NDArray[np.int64]
"""What is compared of a message: grey values, ranges, the keys of occupied cells, or rows of corners."""


@dataclass(frozen=True, eq=False)
class DetectorInputs:
    """What the detector of one sensor is made from."""

    rig: Rig
    name: str
    """Of the sensor."""
    camera: CameraModel | None
    """Its intrinsics; None of sensors without a lens."""
    background: Background | None
    """What it measures without the board; without one it searches by size and shape."""
    plane_estimator: PlaneEstimator | None
    """Estimates the plane of boards with tags in place of one PnP over all corners."""
    seed: int
    """Of its samples."""


@dataclass(frozen=True)
class MotionSignature:
    """How messages of one type show that something moves."""

    compute: Callable[[Any], Signature]
    """What is compared of a message."""
    compare: Callable[[Signature, Signature], float]
    """The share of the view, 0..1, that differs between two messages."""


@dataclass(frozen=True)
class RigKind:
    """One kind of sensor on a robot."""

    detection: type[BoardCorners] | type[PlanePatch] | type[Segment]
    """As what it detects the board."""
    make_detector: Callable[[DetectorInputs], Detector]
    max_messages: Callable[[MaxMessageSettings], int]
    """Most messages of a hold that are searched."""
    messages_per_block: int
    """Messages that a process decodes in one call: milliseconds of work, and no more than 16 MB of raw images."""
    preview_bytes: Callable[[int, int], float]
    """Bytes of a preview with images of a width, px, and a number of points."""
    motion: Mapping[type[Measurement], MotionSignature] = field(default_factory=dict)
    """By type of message, of those that no other kind has."""
    learn_background: Callable[[Sequence[Message], DetectionSettings], Background] | None = None
    """From messages without board and operator; None of cameras."""
    learns_from_captures: bool = False
    """Whether its background also follows from the captures, in which the board is in different places."""


def compare_values(before: Signature, after: Signature, changed: Callable[[Signature, Signature], Any]) -> float:
    """The share of values that changed; all did where their number differs."""
    if after.shape != before.shape:
        return 1.0
    return float(np.mean(changed(before, after))) if after.size else 0.0

"""What the wing needs to know of a kind of sensor: how it detects the board, and how its view changes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.camera import PlaneEstimator
from calgraph.boards.detections import BoardCorners, Detection, DetectionResult, PlanePatch, Segment
from calgraph.boards.tags import Marks
from calgraph.config import Rig
from calgraph.config.settings import DetectionSettings, MaxMessageSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, measure_lengths
from calgraph.rig.detection.capture_background import CaptureBackground, CloudBackground
from calgraph.rig.detection.hold_motion import drop_moved
from calgraph.sensors import CameraModel, LaserScan, Measurement, Message, PointCloud, ScanBackground

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
    marks: Mapping[float, Sequence[Marks]]
    """By stamp of an image that was searched before, what each finder found in it."""


@dataclass(frozen=True)
class MotionSignature:
    """How messages of one type show that something moves."""

    compute: Callable[[Any], Signature]
    """What is compared of a message."""
    compare: Callable[[Signature, Signature], float]
    """The share of the view, 0..1, that differs between two messages."""
    noise: float
    """Largest share that differs while the board rests, as noise, breath and tremor make it."""


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


def make_generator(seed: int, messages: Sequence[PointCloud | LaserScan]) -> np.random.Generator:
    """The generator of one sensor and capture, independent of the order in which captures are searched."""
    first = messages[0].stamp if messages else 0.0
    return np.random.default_rng([seed, int(np.float64(first).view(np.uint64))])


# Directions of detections are those of beams but for rounding.
_MARGIN = 1e-6


def select_resting(
    found: Sequence[Detection] | Rejected, messages: Sequence[PointCloud | LaserScan]
) -> DetectionResult:
    """A scanner's detections that rest in the messages; those in one message with the times of beams, if known."""
    detections = found if isinstance(found, Rejected) else drop_moved(found, [one.points for one in messages])
    if isinstance(detections, Rejected):
        return detections
    beams = _find_timed_beams(messages[0]) if len(messages) == 1 else None
    if beams is None:
        return detections
    from scipy.spatial import cKDTree

    directions, times = _select_beams_near(*beams, detections)
    nearest = cKDTree(directions)  # one for all candidates: making it takes as long as all searches
    return tuple(
        replace(one, times=np.asarray(times[nearest.query(one.directions)[1]], dtype=np.float64))
        if isinstance(one, PlanePatch | Segment)
        else one
        for one in detections
    )


def _select_beams_near(directions: Array, times: Array, detections: Sequence[Detection]) -> tuple[Array, Array]:
    """The beams in the bounding boxes of the detections' directions, a tenth of a sweep."""
    near = np.zeros(len(directions), dtype=np.bool_)
    columns = np.ascontiguousarray(directions.T)
    for one in detections:
        if isinstance(one, PlanePatch | Segment):
            low, high = one.directions.min(axis=0) - _MARGIN, one.directions.max(axis=0) + _MARGIN
            inside = [(along >= a) & (along <= b) for along, a, b in zip(columns, low, high, strict=True)]
            near |= inside[0] & inside[1] & inside[2]
    return directions[near], times[near]


def _find_timed_beams(message: PointCloud | LaserScan) -> tuple[Array, Array] | None:
    """Directions (N, 3) and times (N,) of the beams with a measurement; None without times."""
    if isinstance(message, LaserScan):
        if message.time_increment == 0:
            return None
        angles = message.angles
        directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
        return directions, np.arange(len(angles), dtype=np.float64) * message.time_increment
    if message.times is None:
        return None
    norm = measure_lengths(message.points)
    some = norm > 0
    return np.asarray(message.points[some] / norm[some, None], dtype=np.float64), message.times[some]

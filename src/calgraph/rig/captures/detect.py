"""From holds to detections: the messages of each hold are collected from the stream and searched."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from calgraph.boards.detections import Detection, DetectionResult, InconsistentTags
from calgraph.config import Intrinsics, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.result import Snapshot, state_intrinsics
from calgraph.result.finding import Finding
from calgraph.rig.captures.camera_noise import scale_by_measured_noise
from calgraph.rig.captures.hold_messages import Messages, Search, search_holds
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.misplaced_tags import find_misplaced_tags
from calgraph.rig.captures.previews import PreviewSize, make_preview
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel, Message

Detector = Callable[[Sequence[Any]], DetectionResult]
"""Finds the board in the messages that one sensor sent during one hold."""
# Fewer searches of a sensor's messages of a hold than these, of about 20 ms, end before other processes help.
_MIN_PARALLEL_SEARCHES = 16


@dataclass(frozen=True, eq=False)
class SensorCapture:
    """What one sensor detected in one capture."""

    capture: int
    sensor: str
    detections: DetectionResult
    snapshot: Snapshot | None = None
    """A preview of its messages, where one is kept."""


@dataclass(frozen=True, eq=False)
class CaptureSet:
    """The detections of all captures of a recording: everything that the solvers need."""

    start: float
    """Start of the recording, s."""
    frames: Mapping[str, str]
    """frame_id by sensor, as its messages state it."""
    holds: tuple[Hold, ...]
    detections: Mapping[str, Mapping[int, tuple[Detection, ...]]]
    """By sensor and capture; several candidates where the sensor alone does not decide which one is the board."""
    rejections: Mapping[tuple[int, str], str]
    """By capture and sensor, why there is no detection."""
    cameras: Mapping[str, CameraModel]
    """Intrinsics by camera."""
    snapshots: tuple[Snapshot, ...] = ()
    """Previews of the captures for report and viewer; not part of a saved problem."""
    findings: tuple[Finding, ...] = ()
    """What does not fit the rig in the messages of the recording."""
    estimated_intrinsics: Mapping[str, Intrinsics] = field(default_factory=dict)
    """By camera whose intrinsics were estimated; the rig of a saved problem has them."""

    def count_shared(self) -> int:
        """The number of captures in which at least two sensors detected the board."""
        return sum(count >= 2 for count in Counter(chain.from_iterable(self.detections.values())).values())


def collect_detections(
    rig: Rig,
    timeline: RecordingTimeline,
    holds: Sequence[Hold],
    sensor_captures: Iterable[SensorCapture],
    cameras: Mapping[str, CameraModel],
    findings: Sequence[Finding] = (),
) -> CaptureSet:
    """Sorts by detections and rejections; scales covariances of cameras by the noise of all their corners."""
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in timeline.sensors}
    rejections: dict[tuple[int, str], str] = {}
    inconsistent: dict[str, list[InconsistentTags]] = {}
    snapshots: list[Snapshot] = []
    for sensor_capture in sensor_captures:
        if sensor_capture.snapshot:
            snapshots.append(sensor_capture.snapshot)
        if isinstance(sensor_capture.detections, Rejected):
            rejections[sensor_capture.capture, sensor_capture.sensor] = sensor_capture.detections.reason
            if isinstance(sensor_capture.detections, InconsistentTags):
                inconsistent.setdefault(sensor_capture.sensor, []).append(sensor_capture.detections)
        else:
            detections[sensor_capture.sensor][sensor_capture.capture] = sensor_capture.detections
    for name, spec in rig.cameras().items():
        detections[name] = scale_by_measured_noise(detections[name], spec.noise.pixel)
    frames = {name: times.frame_id for name, times in timeline.sensors.items()}
    misplaced = [
        finding
        for name in cameras
        for finding in find_misplaced_tags(name, detections[name].values(), inconsistent.get(name, ()))
    ]
    return CaptureSet(
        timeline.start,
        frames,
        tuple(holds),
        detections,
        rejections,
        cameras,
        tuple(sorted(snapshots, key=lambda snapshot: snapshot.capture)),
        (*findings, *misplaced),
    )


def state_estimated_intrinsics(rig: Rig, captures: CaptureSet) -> Rig:
    """The rig with the intrinsics that were estimated from its captures."""
    pass
    estimated = {
        name: state_intrinsics(rig.cameras()[name], intrinsics)
        for name, intrinsics in captures.estimated_intrinsics.items()
    }
    return rig.model_copy(update={"sensors": {**rig.sensors, **estimated}})


def detect_in_holds(
    messages: Messages,
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    detectors: Mapping[str, Detector],
    *,
    preview_sizes: Mapping[int, PreviewSize] | None = None,
    skipped: Collection[Search] = (),
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] | None = None,
) -> Iterator[SensorCapture]:
    """Detects the board for every sensor in every hold, with the messages of few holds in memory at a time.

    Messages are decoded and searched by the engine, on which the result does not depend.

    Args:
        messages: of all sensors.
        holds: with the stamps of the messages to use.
        topics: topic by sensor.
        detectors: by sensor.
        preview_sizes: by capture, the size of the previews of its messages; captures that are not in it have none.
        skipped: captures and sensors that are left out.
        engine: searches.
        progress: called with the number of captures and sensors done.

    Yields:
        The detections of every hold and sensor.

    Raises:
        RecordingError: the content of a message is unusable.
        CalibrationError: a process was killed.
    """
    engine = engine if len(holds) * len(topics) >= _MIN_PARALLEL_SEARCHES else THIS_PROCESS
    searched = search_holds(
        detect_in_hold, detectors, messages, holds, topics,
        engine=engine, preview_sizes=preview_sizes, skipped=skipped,
    )  # fmt: skip
    for done, found in enumerate(searched, start=1):
        yield found
        if progress:
            progress(done)


def detect_in_hold(
    detectors: Mapping[str, Detector],
    capture: int,
    name: str,
    decoders: Sequence[Callable[[], Message]],
    size: PreviewSize | None,
) -> SensorCapture:
    """The detections of one sensor in one capture, from functions that decode its messages."""
    if not decoders:
        return SensorCapture(capture, name, Rejected("no message was measured entirely within the hold"))
    messages = [decode() for decode in decoders]
    snapshot = make_preview(capture, name, messages, size) if size else None
    return SensorCapture(capture, name, detectors[name](messages), snapshot)


def limit_messages(holds: Iterable[Hold], rig: Rig) -> tuple[Hold, ...]:
    """The same holds with the messages of each sensor that sharpen a detection, spread over the hold."""
    limits = {name: rig.settings.captures.max_messages.of(spec.kind) for name, spec in rig.sensors.items()}
    return tuple(
        replace(hold, stamps={name: sample_evenly(stamps, limits[name]) for name, stamps in hold.stamps.items()})
        for hold in holds
    )


def sample_evenly(stamps: Array, count: int) -> Array:
    """At most ``count`` of the stamps (N,), evenly chosen."""
    if len(stamps) <= count:
        return stamps
    sampled: Array = stamps[np.linspace(0, len(stamps) - 1, count).round().astype(int)]
    return sampled

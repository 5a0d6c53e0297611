"""What all sensors detected in the captures of a recording: sorted, with the noise of cameras measured."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from calgraph.boards.detections import (
    BoardCorners,
    Detection,
    DetectionResult,
    InconsistentTags,
    PlanePatch,
    Segment,
)
from calgraph.config import Intrinsics, Rig
from calgraph.errors import Rejected
from calgraph.result import Snapshot, state_intrinsics
from calgraph.result.finding import Finding
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel


@dataclass(frozen=True, eq=False)
class SensorCapture:
    """What one sensor detected in one capture."""

    capture: int
    sensor: str
    detections: DetectionResult
    snapshot: Snapshot | None = None
    """A preview of its messages, where one is kept."""

    def rename(self, sensor: str) -> "SensorCapture":
        """The same of a sensor with another name."""
        return replace(self, sensor=sensor, snapshot=self.snapshot and replace(self.snapshot, sensor=sensor))


CAPTURE_TYPES = (SensorCapture, PlanePatch, Segment, BoardCorners, Rejected, InconsistentTags, Snapshot)
"""The classes in what a sensor detected in a capture, which :mod:`calgraph.io.records` keeps."""


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
        (*findings, *misplaced, *find_legacy_prints(detections)),
    )


def state_estimated_intrinsics(rig: Rig, captures: CaptureSet) -> Rig:
    """The rig with the intrinsics that were estimated from its captures."""
    estimated = {
        name: state_intrinsics(rig.cameras()[name], intrinsics)
        for name, intrinsics in captures.estimated_intrinsics.items()
    }
    return rig.model_copy(update={"sensors": {**rig.sensors, **estimated}})


# Minimum degrees of freedom of an estimate: its relative standard deviation is 1 / sqrt(2 x 24) = 14 %.
_MIN_DEGREES_OF_FREEDOM = 24
# Minimum noise of a corner, px: errors of the distortion model shift all corners of a board, which the residuals
# of one PnP do not show; corners of the AprilTag library scatter by 0.05 to 0.1 px.
_MIN_NOISE = 0.05


def scale_by_measured_noise(
    detections: Mapping[int, Sequence[Detection]], stated: float
) -> dict[int, tuple[Detection, ...]]:
    """Scales the covariances of one camera's detections to the noise estimated from all their residuals.

    Args:
        detections: one camera's detections by capture; each covariance is for the larger of the stated noise and
            the RMS of its residuals.
        stated: standard deviation of a corner in x and in y, pixels.

    Returns:
        The same detections, each with a covariance for the larger of the estimated noise and the RMS of its
        residuals; unchanged if there are too few corners for an estimate.
    """
    boards = [d for found in detections.values() for d in found if isinstance(d, BoardCorners)]
    freedom = sum(2 * len(d.pixels) - 6 for d in boards)
    if freedom < _MIN_DEGREES_OF_FREEDOM:
        return {capture: tuple(found) for capture, found in detections.items()}
    squares = sum(2 * len(d.pixels) * d.rms**2 for d in boards)
    variance = max(squares / freedom, _MIN_NOISE**2)

    def rescale(detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        squared_rms = detection.rms**2
        scale = max(variance, squared_rms) / max(stated**2, squared_rms)
        return replace(
            detection, covariance=scale * detection.covariance, plane_covariance=scale * detection.plane_covariance
        )

    return {capture: tuple(map(rescale, found)) for capture, found in detections.items()}


def find_legacy_prints(detections: Mapping[str, Mapping[int, Sequence[Detection]]]) -> Iterator[Finding]:
    """A finding for each ChArUco board, by its index, that is printed in the layout before OpenCV 4.6."""
    found = (one for by_capture in detections.values() for some in by_capture.values() for one in some)
    for _ in sorted({one.board for one in found if isinstance(one, BoardCorners) and one.legacy}):
        yield Finding(
            "the ChArUco print is of the layout before OpenCV 4.6, with a marker at the top left: it is used as "
            "such"
        )


# Minimum number of captures in which a tag is an outlier: one or two may be accidents.
_MIN_CAPTURES = 3
# The same over the captures in which the camera detected several tags: a misplaced tag is an outlier in all in
# which the others are the majority, or in half where two tags contradict each other.
_MIN_SHARE = 0.5


def find_misplaced_tags(
    camera: str, detected: Iterable[Sequence[Detection]], inconsistent: Sequence[InconsistentTags]
) -> Iterator[Finding]:
    """A finding if tags are outliers in most captures of a camera in which it detected more than one.

    Args:
        camera: name of the camera.
        detected: the detected boards of each capture.
        inconsistent: of each capture in which tags were detected that do not fit together.
    """
    boards = [one for found in detected for one in found if isinstance(one, BoardCorners)]
    several = sum(len(one.corners_board) > 4 or bool(one.outlier_tags) for one in boards) + len(inconsistent)
    outliers = Counter(tag for one in boards for tag in one.outlier_tags)
    outliers.update(tag for one in inconsistent for tag in one.tags)
    least = max(_MIN_CAPTURES, _MIN_SHARE * several)
    tags = sorted(tag for tag, count in outliers.items() if count >= least)
    if tags:
        names = (
            f"tag {tags[0]} is an outlier" if len(tags) == 1 else f"tags {', '.join(map(str, tags))} are outliers"
        )
        yield Finding(
            f"{names} in up to {max(outliers[tag] for tag in tags)} of the {several} captures in which {camera} "
            "detected several tags: the board is not as in rig.yaml; check the tags' ids, centres, orientation "
            "and size there",
            (camera,),
        )

"""The captures of a live session: their detections, whether a pose is new, and what they cover of each view."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, DetectionResult, PlanePatch, Segment
from calgraph.config import CameraSpec, Rig
from calgraph.config.settings import LiveCaptureSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, so3
from calgraph.live.analysis_jobs import UnprojectedBoard
from calgraph.live.live_timeline import LiveTimeline
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.holds import Hold
from calgraph.sensors import CameraModel

# Regions of an image along each axis, and sectors of azimuth: as the page draws them.
_REGIONS, _SECTORS = 3, 12
# What sensors detect, the most reliable first: a scanner may take a wall for the board.
_RELIABILITY = (BoardCorners, PlanePatch, Segment)


@dataclass(frozen=True, eq=False)
class LiveCapture:
    """One capture, and what every sensor detected in it."""

    hold: Hold
    """With the stamps of the messages that were searched; its index does not matter."""
    detections: Mapping[str, DetectionResult]
    """By sensor."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Those that detected the board, cameras without intrinsics too."""
        return tuple(name for name, found in self.detections.items() if has_board(found))


def has_board(found: DetectionResult) -> bool:
    """Whether a sensor detected the board."""
    return not isinstance(found, Rejected) or isinstance(found, UnprojectedBoard)


def collect_live_captures(
    rig: Rig, timeline: LiveTimeline, captures: Sequence[LiveCapture], cameras: Mapping[str, CameraModel]
) -> CaptureSet:
    """The captures as :func:`calgraph.calibrate_rig` has them of the recording."""
    holds = [replace(capture.hold, index=i) for i, capture in enumerate(captures)]
    found = (
        SensorCapture(i, name, capture.detections[name])
        for name in rig.sensors
        for i, capture in enumerate(captures)
    )
    times = timeline.snapshot([hold.start for hold in holds], start=timeline.latest_arrival)
    return collect_detections(rig, times, holds, found, cameras)


def find_same_pose(
    detections: Mapping[str, DetectionResult], captures: Sequence[LiveCapture], settings: LiveCaptureSettings
) -> int | None:
    """The index of an earlier capture of the same board pose; None if there is none.

    Poses are compared by the most reliable sensors that detected the board in both.
    """
    for i, capture in enumerate(captures):
        ranked = [
            (_RELIABILITY.index(type(before[0])), before[0], found[0])
            for before, found in ((one, detections[name]) for name, one in capture.detections.items())
            if not isinstance(before, Rejected) and not isinstance(found, Rejected)
        ]
        best = min((rank for rank, _, _ in ranked), default=0)
        if ranked and all(_are_close(a, b, settings) for rank, a, b in ranked if rank == best):
            return i
    return None


def _are_close(a: Detection, b: Detection, settings: LiveCaptureSettings) -> bool:
    """Whether two detections of one sensor are of nearly the same board pose."""
    distance = float(np.linalg.norm(a.center - b.center))
    return distance < settings.min_distance and np.degrees(_measure_rotation(a, b)) < settings.min_angle


def _measure_rotation(a: Detection, b: Detection) -> float:
    """Angle between two boards as far as the sensor measures it, rad."""
    if isinstance(a, BoardCorners) and isinstance(b, BoardCorners):
        return float(np.linalg.norm(so3.log(a.T_camera_board[:3, :3].T @ b.T_camera_board[:3, :3])))
    first, second = _direction(a), _direction(b)
    cosine = float(first @ second)
    # The ends of a segment may be exchanged.
    return float(np.arccos(np.clip(abs(cosine) if isinstance(a, Segment) else cosine, -1, 1)))


def _direction(detection: Detection) -> Array:
    """Of a segment along it, of a plane its normal (3,)."""
    if isinstance(detection, Segment):
        along = detection.endpoints[1] - detection.endpoints[0]
        return np.asarray(along / np.linalg.norm(along))
    return np.asarray(detection.plane[:3])


# Number of captures after which a region of a view is covered: lenses and patches need several.
_COVERING_CAPTURES = 3


def count_coverage(
    name: str, rig: Rig, camera: CameraModel | None, captures: Iterable[LiveCapture]
) -> tuple[float, ...]:
    """How well the captures cover the view of a sensor, 0..1.

    Returns:
        Of a camera for 3 x 3 regions of its images, row by row; of scanners for 12 sectors of azimuth from -180 to
        180 degrees. 1 after ``settings.covering_captures`` captures with the board there.
    """
    results = (capture.detections[name] for capture in captures)
    found = [one[0] for one in results if not isinstance(one, Rejected)]
    if isinstance(rig.sensors[name], CameraSpec):
        counts = np.zeros(_REGIONS**2)
        for one in found:
            if isinstance(one, BoardCorners) and camera:
                size = np.array([camera.width, camera.height])
                column, row = np.clip((_REGIONS * one.pixels / size).astype(int), 0, _REGIONS - 1).T
                counts[np.unique(_REGIONS * row + column)] += 1
    else:
        counts = np.zeros(_SECTORS)
        for one in found:
            azimuth = np.arctan2(one.center[1], one.center[0])
            counts[min(int(_SECTORS * (azimuth + np.pi) / (2 * np.pi)), _SECTORS - 1)] += 1
    return tuple(np.minimum(counts / _COVERING_CAPTURES, 1).tolist())


def explain_rejection(reason: str) -> str:
    """The reason why a sensor does not detect the board, in a few words for the operator."""
    for words, short in (
        ("board moved between", "the board moved"),
        ("too small", "too far"),
        ("too dark", "too dark"),
        ("blank", "blank image"),
        ("corners detected", "partly hidden"),
        ("not on the board", "another tag in view"),
        ("no message", "no message"),
        ("memory", "messages too large"),
    ):
        if words in reason:
            return short
    return "not in view"

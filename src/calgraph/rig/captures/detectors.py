"""The detector of every sensor of a rig, and the background models of its scanners."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.boards.camera import CameraDetector, PlaneEstimator
from calgraph.boards.detections import Detection, DetectionResult, PlanePatch, Segment
from calgraph.config import CameraSpec, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.config.settings import DetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, measure_lengths
from calgraph.recording import Recording
from calgraph.rig.captures.holds import Hold, sample_evenly
from calgraph.rig.detection.background_learning import learn_cloud_background, learn_scan_background
from calgraph.rig.detection.capture_background import CaptureBackground, learn_capture_background
from calgraph.rig.detection.cloud_background import CloudBackground
from calgraph.rig.detection.lidar2d import find_segments
from calgraph.rig.detection.lidar3d import find_patches
from calgraph.sensors import (
    CameraModel,
    LaserScan,
    Message,
    PointCloud,
    RecordedMessage,
    ScanBackground,
)
from calgraph.sensors.cloud_to_scan import to_scans

Detector = Callable[[Sequence[Any]], DetectionResult]
"""Finds the board in the messages that one sensor sent during one hold."""
Background = CloudBackground | CaptureBackground | ScanBackground


def learn_backgrounds(records: Iterable[RecordedMessage], rig: Rig) -> Mapping[str, Background | Rejected]:
    """Learns what the scanners measure without target and operator.

    Args:
        records: the scanners' records in the background window.
        rig: the rig.

    Returns:
        By scanner, or why there is none: it measured nothing in the window. Empty without a window.
    """
    by_topic = {spec.topic: name for name, spec in rig.sensors.items() if not isinstance(spec, CameraSpec)}
    messages_by_sensor: dict[str, list[Message]] = {}
    for record in records:
        messages = messages_by_sensor.setdefault(by_topic[record.topic], [])
        if len(messages) < rig.settings.captures.max_background_messages:
            messages.append(record.decode())
    backgrounds: dict[str, Background | Rejected] = {}
    for name in by_topic.values() if rig.capture.background else ():
        try:
            backgrounds[name] = learn_background(
                messages_by_sensor.get(name, []), rig.sensors[name], rig.settings.detection
            )
        except InputError as error:
            backgrounds[name] = Rejected(str(error))
    return backgrounds


def learn_background(messages: Sequence[Message], spec: object, settings: DetectionSettings) -> Background:
    """The background model of one scanner."""
    if isinstance(spec, Lidar2dSpec):
        return learn_scan_background(to_scans(messages))
    return learn_cloud_background([m for m in messages if isinstance(m, PointCloud)], settings)


# Maximum number of captures that it is learned from, evenly chosen: bounds time and memory.
_MAX_CAPTURES = 32


def learn_backgrounds_of_captures(
    rig: Rig, recording: Recording, holds: Sequence[Hold], without: Collection[str]
) -> dict[str, CaptureBackground]:
    """Learns the background of 3-D LiDARs from their captures.

    Args:
        rig: the rig.
        recording: to read.
        holds: with the stamps of the messages to use.
        without: sensors that are left out: their background is known.

    Returns:
        By LiDAR; those with too few captures are left out.
    """
    settings = rig.settings.detection
    lidars = {
        name: spec for name, spec in rig.sensors.items() if isinstance(spec, Lidar3dSpec) and name not in without
    }
    learned = {}
    for name, spec in lidars.items():
        stamps = [hold.stamps[name][0] for hold in holds if not hold.auxiliary and len(hold.stamps[name])]
        if len(stamps) < settings.capture_background.min_captures:
            continue
        chosen = set(sample_evenly(np.array(stamps), _MAX_CAPTURES).tolist())
        messages = (record.decode() for record in recording.records([spec.topic]) if record.stamp in chosen)
        clouds = (message for message in messages if isinstance(message, PointCloud))
        learned[name] = learn_capture_background(clouds, spec.noise, settings)
    return learned


def draw_seeds(rig: Rig, rng: np.random.Generator) -> dict[str, int]:
    """A seed for the samples of each sensor's detector."""
    return dict(zip(rig.sensors, rng.integers(2**63, size=len(rig.sensors)).tolist(), strict=True))


def make_detectors(
    rig: Rig,
    cameras: Mapping[str, CameraModel],
    backgrounds: Mapping[str, Background],
    plane_estimator: PlaneEstimator | None,
    seeds: Mapping[str, int],
) -> Mapping[str, Detector]:
    """The detector of each sensor.

    Args:
        rig: the rig.
        cameras: intrinsics by camera.
        backgrounds: by scanner; those without one search by size and shape.
        plane_estimator: estimates the plane of boards with tags in place of one PnP over all corners.
        seeds: of the detectors' samples, by sensor; see :func:`draw_seeds`.
    """
    detectors: dict[str, Detector] = {}
    for name, spec in rig.sensors.items():
        background, seed = backgrounds.get(name), seeds[name]
        if isinstance(spec, CameraSpec):
            detectors[name] = CameraDetector(
                rig.boards, cameras[name], spec.noise, rig.settings.detection.camera, plane_estimator
            ).find
        elif isinstance(spec, Lidar3dSpec):
            cloud_background = background if isinstance(background, CloudBackground | CaptureBackground) else None
            detectors[name] = partial(_detect_patches, rig=rig, spec=spec, background=cloud_background, seed=seed)
        else:
            scan_background = background if isinstance(background, ScanBackground) else None
            detectors[name] = partial(_detect_segments, rig=rig, spec=spec, background=scan_background, seed=seed)
    return detectors


# Score of the best candidate in front of the static scene below which the whole cloud is searched: boards that
# are not occluded have 0.65 to 1.
_MIN_SCORE = 0.6


def _detect_patches(
    messages: Sequence[PointCloud],
    rig: Rig,
    spec: Lidar3dSpec,
    background: CloudBackground | CaptureBackground | None,
    seed: int,
) -> DetectionResult:
    settings = rig.settings.detection

    def find(known: CloudBackground | CaptureBackground | None) -> tuple[PlanePatch, ...] | Rejected:
        return find_patches(messages, rig.boards, spec.noise, known, _make_generator(seed, messages), settings)

    found = find(background)
    if isinstance(background, CaptureBackground) and not _has_board(found, _MIN_SCORE):
        # A board that stood in the same place in most captures is part of what was learned.
        found = find(None)
    return found if isinstance(found, Rejected) else add_beam_times(found, messages)


def _has_board(found: tuple[PlanePatch, ...] | Rejected, min_score: float) -> bool:
    return not isinstance(found, Rejected) and found[0].match >= min_score


def _detect_segments(
    messages: Sequence[Message], rig: Rig, spec: Lidar2dSpec, background: ScanBackground | None, seed: int
) -> DetectionResult:
    scans = to_scans(messages)
    found = find_segments(
        scans, rig.boards, spec.noise, background, _make_generator(seed, scans), rig.settings.detection
    )
    return found if isinstance(found, Rejected) else add_beam_times(found, scans)


def _make_generator(seed: int, messages: Sequence[PointCloud | LaserScan]) -> np.random.Generator:
    """The generator of one sensor and capture, independent of the order in which captures are searched."""
    first = messages[0].stamp if messages else 0.0
    return np.random.default_rng([seed, int(np.float64(first).view(np.uint64))])


# Directions of detections are those of beams but for rounding.
_MARGIN = 1e-6


def add_beam_times(
    detections: Sequence[Detection], messages: Sequence[PointCloud | LaserScan]
) -> tuple[Detection, ...]:
    """The detections in one message with the times of their beams; unchanged where these are not known.

    Args:
        detections: of a scanner.
        messages: that they were found in.
    """
    beams = _find_timed_beams(messages[0]) if len(messages) == 1 else None
    if beams is None:
        return tuple(detections)
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

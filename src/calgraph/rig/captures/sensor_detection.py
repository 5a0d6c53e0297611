"""Detection of the board by all sensors; what an earlier run detected is taken from the cache."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.boards.camera import PlaneEstimator
from calgraph.boards.detections import BoardCorners, Detection, InconsistentTags
from calgraph.config import CameraSpec, Rig
from calgraph.errors import Rejected
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.result import Snapshot
from calgraph.rig.captures.detect import SensorCapture, detect_in_holds
from calgraph.rig.captures.detection_tables import pack_detections, unpack_detections
from calgraph.rig.captures.detectors import learn_backgrounds, learn_backgrounds_of_captures, make_detectors
from calgraph.rig.captures.hold_messages import select_messages
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.previews import PreviewSize, plan_previews
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel, RecordedMessage

_log = logging.getLogger(__name__)

_DETECTIONS = "detections/4"
# In the cache: a run that is ended loses a few captures, and writing the entries takes little time.
_ENTRIES_PER_SENSOR = 16
_Entry = tuple[str, tuple[int, ...]]
"""A sensor, and captures whose detections are kept together."""


@dataclass(frozen=True, eq=False)
class DetectionMethod:
    """How the board is detected, besides what the rig states."""

    cameras: Mapping[str, CameraModel]
    """Intrinsics by camera."""
    seeds: Mapping[str, int]
    """Of the random samples, by sensor."""
    plane: str = "pnp"
    """Name of the estimator of a board's plane from its tags,"""
    plane_estimator: PlaneEstimator | None = None
    """and the estimator itself; None for one PnP over all corners."""


@dataclass(frozen=True, eq=False)
class _SensorDetections:
    """What one sensor detected in the captures of one entry of the cache."""

    captures: tuple[SensorCapture, ...]
    no_background: str
    """Why nothing was learned in the background window; empty if there is none, or a background was learned."""


def detect_by_sensors(
    rig: Rig,
    recording: Recording,
    timeline: RecordingTimeline,
    holds: Sequence[Hold],
    method: DetectionMethod,
    *,
    cache: RecordingCache = NO_CACHE,
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _: None,
) -> list[SensorCapture]:
    """Detects the board in every sensor's messages of every hold.

    Args:
        rig: the rig.
        recording: to read.
        timeline: of the recording.
        holds: with the stamps of the messages to use.
        method: of the detection.
        cache: has what earlier runs detected, and gets the others as they are found.
        engine: searches; the result does not depend on it.
        progress: called with the share of the detections that is done.

    Returns:
        The detections, sensor by sensor, in the order of the holds.

    Raises:
        RecordingError: the content of a message is unusable.
        CalibrationError: a process was killed.
    """
    previews = plan_previews([hold for hold in holds if not hold.auxiliary], rig)
    of_sensors = {name: _list_inputs(name, rig, holds, method, previews) for name in rig.sensors}
    inputs = {
        (name, captures): {**given, "searched": list(captures)}
        for name, given in of_sensors.items()
        for captures in _group_captures(holds)
    }
    found = {
        entry: kept
        for entry, given in inputs.items()
        if (kept := cache.read(recording, _DETECTIONS, given, partial(_decode, entry[0]))) is not None
    }
    missing = [entry for entry in inputs if entry not in found]
    unread = {name for name, _ in missing}
    if reused := [name for name in rig.sensors if name not in unread]:
        cache.reused.update(reused)
        _log.info("detections of %s: from the cache", ", ".join(reused))
    if missing:
        part = rig.model_copy(
            update={"sensors": {name: rig.sensors[name] for name in rig.sensors if name in unread}}
        )
        for entry, detected in _detect_missing(
            part, recording, timeline, holds, method, previews, missing, engine, progress
        ):
            found[entry] = detected
            content, arrays = encode_captures(detected.captures)
            content["no_background"] = detected.no_background
            cache.write(recording, _DETECTIONS, inputs[entry], content, arrays)
    for name in rig.sensors:
        if reason := next((found[entry].no_background for entry in inputs if entry[0] == name), ""):
            # A scanner without measurements does not keep the others from being calibrated.
            _log.warning("%s: %s; it detects the board by size and shape", name, reason)
    return [capture for entry in inputs for capture in found[entry].captures]


def _group_captures(holds: Sequence[Hold]) -> list[tuple[int, ...]]:
    """The captures of each entry."""
    size = max(-(-len(holds) // _ENTRIES_PER_SENSOR), 1)
    return [tuple(hold.index for hold in holds[k : k + size]) for k in range(0, len(holds), size)]


def _detect_missing(
    rig: Rig,
    recording: Recording,
    timeline: RecordingTimeline,
    holds: Sequence[Hold],
    method: DetectionMethod,
    previews: Mapping[int, PreviewSize],
    missing: Sequence[_Entry],
    engine: Engine,
    progress: Callable[[float], None],
) -> Iterator[tuple[_Entry, _SensorDetections]]:
    """What the sensors of a rig detect in the captures of the missing entries, as soon as each is complete."""
    backgrounds = learn_backgrounds(_background_records(rig, recording), rig)
    models = {name: one for name, one in backgrounds.items() if not isinstance(one, Rejected)}
    models |= learn_backgrounds_of_captures(rig, recording, holds, without=models)
    entries = {(capture, name): (name, captures) for name, captures in missing for capture in captures}
    detected: dict[_Entry, dict[int, SensorCapture]] = {entry: {} for entry in missing}
    for found in detect_in_holds(
        select_messages(rig, recording, timeline, engine) or recording.records(rig.topics.values()),
        holds,
        rig.topics,
        make_detectors(rig, method.cameras, models, method.plane_estimator, method.seeds),
        preview_sizes=previews,
        skipped={(hold.index, name) for hold in holds for name in rig.sensors} - entries.keys(),
        engine=engine,
        progress=lambda done: progress(done / len(entries)),
    ):
        entry = entries[found.capture, found.sensor]
        detected[entry][found.capture] = found
        if len(detected[entry]) == len(entry[1]):
            complete, background = detected.pop(entry), backgrounds.get(found.sensor)
            reason = background.reason if isinstance(background, Rejected) else ""
            yield entry, _SensorDetections(tuple(complete[capture] for capture in entry[1]), reason)


def _decode(name: str, content: Mapping[str, Any], arrays: Arrays) -> _SensorDetections:
    return _SensorDetections(decode_captures(name, content, arrays), content["no_background"])


def _background_records(rig: Rig, recording: Recording) -> Iterable[RecordedMessage]:
    """What the scanners measured without target and operator."""
    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    if not window or not scanners:
        return ()
    return recording.records(scanners, *(recording.start + t for t in window))


def list_shared_inputs(name: str, rig: Rig, holds: Sequence[Hold]) -> dict[str, Any]:
    """What all that is found in a sensor's messages depends on: the messages, their noise, and the boards."""
    spec = rig.sensors[name]
    return {
        "topic": spec.topic,
        "noise": spec.noise,
        "boards": [board.model_dump(mode="json", exclude={"uncertainty"}) for board in rig.boards],
        "captures": [(hold.index, hold.stamps[name]) for hold in holds],
    }


def _list_inputs(
    name: str, rig: Rig, holds: Sequence[Hold], method: DetectionMethod, previews: Mapping[int, PreviewSize]
) -> dict[str, Any]:
    """What the detections of a sensor depend on, besides the recording.

    Neither names nor prior standard deviations are among it, nor what concerns other sensors only.
    """
    spec, settings = rig.sensors[name], rig.settings
    inputs: dict[str, Any] = {
        **list_shared_inputs(name, rig, holds),
        "kind": spec.kind,
        "previews": [vars(previews[hold.index]) if hold.index in previews else None for hold in holds],
    }
    if isinstance(spec, CameraSpec):
        camera = method.cameras[name]
        return inputs | {
            "camera": [camera.model, camera.width, camera.height, camera.K, camera.distortion],
            "plane": method.plane,
            "settings": settings.detection.camera,
        }
    return inputs | {
        "seed": method.seeds[name],
        "background": rig.capture.background,
        "max_background_messages": settings.captures.max_background_messages,
        "settings": settings.detection.model_dump(mode="json", exclude={"camera"}),
    }


_SNAPSHOTS = Table("snapshots", {
    "position": INDEX, "stamp": NUMBER, "width": INDEX, "height": INDEX,
    "image": Column((), np.uint8, ragged=True), "points": Column((3,), np.float32, ragged=True),
})  # fmt: skip


def encode_captures(captures: Sequence[SensorCapture]) -> tuple[dict[str, Any], Arrays]:
    """The captures of one sensor, which are numbered in their order."""
    found: dict[int, tuple[Detection, ...]] = {}
    content: dict[str, Any] = {"captures": [one.capture for one in captures], "rejected": [], "outlier_tags": []}
    for position, one in enumerate(captures):
        if isinstance(one.detections, Rejected):
            tags = one.detections.tags if isinstance(one.detections, InconsistentTags) else None
            content["rejected"].append([position, one.detections.reason, tags])
        else:
            found[position] = one.detections
            outliers = [board.outlier_tags if isinstance(board, BoardCorners) else () for board in one.detections]
            if any(outliers):
                content["outlier_tags"].append([position, outliers])
    snapshots = [
        {**vars(one.snapshot), "position": position, "image": np.frombuffer(one.snapshot.image, np.uint8)}
        for position, one in enumerate(captures)
        if one.snapshot
    ]
    return content, _SNAPSHOTS.pack(snapshots) | pack_detections({"": found})


def decode_captures(sensor: str, content: Mapping[str, Any], arrays: Arrays) -> tuple[SensorCapture, ...]:
    """The captures of a sensor from what :func:`encode_captures` gives.

    Raises:
        InputError: a column is missing, or its values do not fit the others.
        KeyError: a key is missing.
    """
    numbers = content["captures"]
    found = unpack_detections(arrays, [""])[""]
    rejected = {
        position: Rejected(reason) if tags is None else InconsistentTags(reason, tuple(tags))
        for position, reason, tags in content["rejected"]
    }
    for position, outliers in content["outlier_tags"]:
        found[position] = tuple(
            replace(board, outlier_tags=tuple(tags)) if tags and isinstance(board, BoardCorners) else board
            for board, tags in zip(found[position], outliers, strict=True)
        )
    snapshots = {
        row["position"]: Snapshot(
            numbers[row["position"]],
            sensor,
            row["stamp"],
            row["image"].tobytes(),
            row["width"],
            row["height"],
            row["points"],
        )
        for row in _SNAPSHOTS.unpack(arrays)
    }
    return tuple(
        SensorCapture(number, sensor, rejected.get(k) or found.get(k, ()), snapshots.get(k))
        for k, number in enumerate(numbers)
    )

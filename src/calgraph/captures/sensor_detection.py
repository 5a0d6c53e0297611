"""Detection of the board by all sensors; what an earlier run detected is taken from the cache."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from calgraph.captures.capture_encoding import decode_captures, encode_captures
from calgraph.captures.detect import SensorCapture, detect_in_holds
from calgraph.captures.detectors import learn_backgrounds, learn_backgrounds_of_captures, make_detectors
from calgraph.captures.holds import Hold
from calgraph.captures.previews import PreviewSize, plan_previews
from calgraph.config import CameraSpec, Rig
from calgraph.detection import PlaneEstimator
from calgraph.engine import THIS_PROCESS, Engine
from calgraph.errors import Rejected
from calgraph.io.columns import Arrays
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.sensors import CameraModel, RecordedMessage

_log = logging.getLogger(__name__)

_DETECTIONS = "detections/3"


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
    """What one sensor detected in all captures."""

    captures: tuple[SensorCapture, ...]
    no_background: str
    """Why nothing was learned in the background window; empty if there is none, or a background was learned."""


def detect_by_sensors(
    rig: Rig,
    recording: Recording,
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
        holds: with the stamps of the messages to use.
        method: of the detection.
        cache: has what earlier runs detected by sensors, and gets the others.
        engine: searches; the result does not depend on it.
        progress: called with the share of the detections that is done.

    Returns:
        The detections, sensor by sensor, each in the order in which its captures were complete.

    Raises:
        RecordingError: the content of a message is unusable.
        CalibrationError: a process was killed.
    """
    previews = plan_previews([hold for hold in holds if not hold.auxiliary], rig)
    inputs = {name: _list_inputs(name, rig, holds, method, previews) for name in rig.sensors}
    found: dict[str, _SensorDetections] = {
        name: kept
        for name, given in inputs.items()
        if (kept := cache.read(recording, _DETECTIONS, given, partial(_decode, name))) is not None
    }
    if found:
        cache.reused.update(found)
        _log.info("detections of %s: from the cache", ", ".join(found))
    unread = {name: spec for name, spec in rig.sensors.items() if name not in found}
    if unread:
        part = rig.model_copy(update={"sensors": unread})
        backgrounds = learn_backgrounds(_background_records(part, recording), part)
        models = {name: one for name, one in backgrounds.items() if not isinstance(one, Rejected)}
        models |= learn_backgrounds_of_captures(part, recording, holds, without=models)
        detect = make_detectors(part, method.cameras, models, method.plane_estimator, method.seeds)
        detected: dict[str, list[SensorCapture]] = {name: [] for name in unread}
        for capture in detect_in_holds(
            recording.records(part.topics.values()), holds, part.topics, detect, preview_sizes=previews,
            engine=engine, progress=lambda done: progress(done / (len(holds) * len(unread))),
        ):  # fmt: skip
            detected[capture.sensor].append(capture)
        for name, captures in detected.items():
            background = backgrounds.get(name)
            reason = background.reason if isinstance(background, Rejected) else ""
            found[name] = _SensorDetections(tuple(captures), reason)
            content, arrays = encode_captures(captures)
            cache.write(recording, _DETECTIONS, inputs[name], {**content, "no_background": reason}, arrays)
    for name in rig.sensors:
        if found[name].no_background:
            # A scanner without measurements does not keep the others from being calibrated.
            _log.warning("%s: %s; it detects the board by size and shape", name, found[name].no_background)
    return [capture for name in rig.sensors for capture in found[name].captures]


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

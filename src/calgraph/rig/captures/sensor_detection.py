"""Detection of the board by all sensors: an engine searches what an earlier run has not left in the cache."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from calgraph.boards.camera import PlaneEstimator
from calgraph.boards.tags import Marks
from calgraph.config import CameraSpec, Rig
from calgraph.errors import Rejected
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.rig.captures.detect import CAPTURE_TYPES, SensorCapture
from calgraph.rig.captures.detectors import learn_backgrounds, learn_backgrounds_of_captures, make_detectors
from calgraph.rig.captures.hold_messages import (
    PreviewSize,
    Search,
    make_preview,
    plan_previews,
    search_holds,
    select_messages,
)
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.rig.kinds.rig_kind import Detector
from calgraph.sensors import CameraModel, Message, RecordedMessage
from calgraph.sensors.kinds import KINDS, OpticalSpec

_log = logging.getLogger(__name__)

_DETECTIONS = "detections/6"
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
    marks: Mapping[str, Mapping[float, Sequence[Marks]]] = field(default_factory=dict)
    """By camera and stamp of an image that was searched before, what each finder found in it."""
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


KEPT_TYPES = (_SensorDetections, *CAPTURE_TYPES)
"""Classes in an entry of the cache."""


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
    inputs = _list_entries(rig, holds, method, previews)
    found = {
        entry: replace(kept, captures=tuple(one.rename(entry[0]) for one in kept.captures))
        for entry, given in inputs.items()
        if (kept := cache.read(recording, _DETECTIONS, given, KEPT_TYPES)) is not None
    }
    missing = [entry for entry in inputs if entry not in found]
    unread = {name for name, _ in missing}
    if reused := [name for name in rig.sensors if name not in unread]:
        cache.reused.update(reused)
        _log.info("detections of %s: from the cache", ", ".join(reused))
    if missing:
        part = rig.model_copy(update={"sensors": {n: spec for n, spec in rig.sensors.items() if n in unread}})
        backgrounds = learn_backgrounds(_background_records(part, recording), part)
        models = {name: one for name, one in backgrounds.items() if not isinstance(one, Rejected)}
        models |= learn_backgrounds_of_captures(part, recording, holds, without=models)
        entries = {(capture, name): (name, captures) for name, captures in missing for capture in captures}
        searched = search_holds(
            detect_in_hold,
            make_detectors(part, method.cameras, models, method.plane_estimator, method.seeds, method.marks),
            select_messages(part, recording, timeline, engine) or recording.records(part.topics.values()),
            holds,
            part.topics,
            engine=engine,
            preview_sizes=previews,
            skipped={(hold.index, name) for hold in holds for name in part.sensors} - entries.keys(),
            progress=lambda done: progress(done / len(entries)),
        )
        for entry, captures in _complete_entries(searched, entries):
            background = backgrounds.get(entry[0])
            reason = background.reason if isinstance(background, Rejected) else ""
            found[entry] = _SensorDetections(captures, reason)
            cache.write(recording, _DETECTIONS, inputs[entry], found[entry])
    for name in rig.sensors:
        if reason := next((found[entry].no_background for entry in inputs if entry[0] == name), ""):
            # A scanner without measurements does not keep the others from being calibrated.
            _log.warning("%s: %s; it detects the board by size and shape", name, reason)
    return [capture for entry in inputs for capture in found[entry].captures]


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


def _list_entries(
    rig: Rig, holds: Sequence[Hold], method: DetectionMethod, previews: Mapping[int, PreviewSize]
) -> dict[_Entry, dict[str, Any]]:
    """All entries of the cache, and what the detections in each depend on, besides the recording."""
    size = max(-(-len(holds) // _ENTRIES_PER_SENSOR), 1)
    groups = [tuple(hold.index for hold in holds[k : k + size]) for k in range(0, len(holds), size)]
    inputs: dict[_Entry, dict[str, Any]] = {}
    for name in rig.sensors:
        given = _list_inputs(name, rig, holds, method, previews)
        inputs |= {(name, captures): {**given, "searched": list(captures)} for captures in groups}
    return inputs


def _complete_entries(
    searched: Iterable[SensorCapture], entries: Mapping[Search, _Entry]
) -> Iterator[tuple[_Entry, tuple[SensorCapture, ...]]]:
    """The entries with their captures, each as soon as it is complete."""
    detected: dict[_Entry, dict[int, SensorCapture]] = {entry: {} for entry in entries.values()}
    for one in searched:
        entry = entries[one.capture, one.sensor]
        detected[entry][one.capture] = one
        if len(detected[entry]) == len(entry[1]):
            complete = detected.pop(entry)
            yield entry, tuple(complete[capture] for capture in entry[1])


def _background_records(rig: Rig, recording: Recording) -> Iterable[RecordedMessage]:
    """What the scanners measured without target and operator."""
    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if KINDS[spec.kind].measures_ranges]
    if not window or not scanners:
        return ()
    return recording.records(scanners, *(recording.start + t for t in window))


def list_shared_inputs(name: str, rig: Rig, holds: Sequence[Hold]) -> dict[str, Any]:
    """What all that is found in a sensor's messages depends on: the messages, their noise, and the boards."""
    spec = rig.sensors[name]
    # Messages that are converted images depend on the intrinsics.
    intrinsics = spec.stated_intrinsics if isinstance(spec, OpticalSpec) and KINDS[spec.kind].convert else None
    return {
        "topic": spec.topic,
        "noise": spec.noise,
        "intrinsics": intrinsics,
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

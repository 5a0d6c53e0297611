"""Intrinsics of cameras that have none, from the same recording."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.boards.tags import Marks
from calgraph.config import CameraSpec, Rig
from calgraph.errors import Rejected
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.result.finding import Finding
from calgraph.rig.captures.hold_messages import PreviewSize, search_holds, select_messages
from calgraph.rig.captures.holds import Hold, sample_evenly
from calgraph.rig.captures.sensor_detection import detect_in_hold, list_shared_inputs
from calgraph.rig.captures.timeline import RecordingTimeline, build_timeline
from calgraph.rig.detection.board_views import BoardView, BoardViewFinder, ImageMarks
from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
from calgraph.sensors import Message

_log = logging.getLogger(__name__)

_MARKS = "board marks/1"


@dataclass(frozen=True, eq=False)
class EstimatedIntrinsics:
    """What the captures show of the cameras without intrinsics."""

    estimates: Mapping[str, IntrinsicsEstimate]
    """By camera whose intrinsics the captures determine."""
    failed: Mapping[str, Rejected]
    """By each other camera without intrinsics, why not."""
    marks: Mapping[str, Mapping[float, tuple[Marks, ...]]]
    """By camera and stamp of an image, what each finder found in it."""


def estimate_unknown_intrinsics(
    rig: Rig,
    recording: Recording,
    timeline: RecordingTimeline,
    holds: Sequence[Hold],
    engine: Engine,
    progress: Progress = no_progress,
    cache: RecordingCache = NO_CACHE,
) -> EstimatedIntrinsics:
    """Estimates the intrinsics of the cameras without any from all captures.

    Args:
        rig: with the intrinsics of all other cameras.
        recording: open recording with the rig's topics.
        timeline: of the recording.
        holds: the captures.
        engine: searches views.
        progress: called with the step and the fraction done.
        cache: has what earlier runs found in the images of a camera, and gets the others.
    """
    unknown = {name: spec for name, spec in rig.cameras().items() if spec.stated_intrinsics is None}
    found = _find_marks(
        rig, unknown, recording, timeline, holds, engine, lambda done: progress("intrinsics", done), cache
    )
    views = {name: _combine_views(rig, name, of_camera) for name, of_camera in found.items()}
    work = [(rig, name, _list_views(views[name]), spec.lens_to_estimate) for name, spec in unknown.items()]
    estimates = dict(zip(unknown, engine.map(estimate_intrinsics, work), strict=True))
    for name, estimate in estimates.items():
        _log.info("%s: %s", name, estimate.reason if isinstance(estimate, Rejected) else _describe(estimate))
    return EstimatedIntrinsics(
        {name: one for name, one in estimates.items() if not isinstance(one, Rejected)},
        {name: one for name, one in estimates.items() if isinstance(one, Rejected)},
        {name: _list_marks(of_camera) for name, of_camera in found.items()},
    )


def _find_marks(
    rig: Rig,
    cameras: Mapping[str, CameraSpec],
    recording: Recording,
    timeline: RecordingTimeline,
    holds: Sequence[Hold],
    engine: Engine,
    progress: Callable[[float], None],
    cache: RecordingCache,
) -> dict[str, dict[int, tuple[ImageMarks, ...]]]:
    """What is found in the images of cameras, by camera and hold; progress is called with the share done."""
    settings = rig.settings.detection.camera
    inputs = {name: {**list_shared_inputs(name, rig, holds), "settings": settings} for name in cameras}
    marks = {
        name: kept
        for name, given in inputs.items()
        if (kept := cache.read(recording, _MARKS, given, (ImageMarks, Marks))) is not None
    }
    unread = [name for name in cameras if name not in marks]
    if not unread:
        return marks
    topics = {name: cameras[name].topic for name in unread}
    searched = search_holds(
        _find_in_hold,
        {name: BoardViewFinder(rig.boards, cameras[name].noise, settings=settings) for name in unread},
        select_messages(rig, recording, timeline, engine) or recording.records(topics.values()),
        holds,
        topics,
        engine=engine,
        progress=lambda done: progress(done / max(len(holds) * len(unread), 1)),
    )
    found: dict[str, dict[int, tuple[ImageMarks, ...]]] = {name: {} for name in unread}
    for capture, name, of_hold in searched:
        if not isinstance(of_hold, Rejected):
            found[name][capture] = of_hold
    for name in unread:
        marks[name] = dict(sorted(found[name].items()))
        cache.write(recording, _MARKS, inputs[name], marks[name])
    return marks


def _find_in_hold(
    finders: Mapping[str, BoardViewFinder],
    capture: int,
    name: str,
    decoders: Sequence[Callable[[], Message]],
    size: PreviewSize | None,  # noqa: ARG001
) -> tuple[int, str, tuple[ImageMarks, ...] | Rejected]:
    """What is found in one camera's images of one hold, from functions that decode them."""
    return capture, name, finders[name].search([decode() for decode in decoders])


def calibrate_intrinsics(
    rig: Rig,
    recording: Recording,
    engine: Engine = THIS_PROCESS,
    progress: Progress = no_progress,
    cache: RecordingCache = NO_CACHE,
) -> dict[str, IntrinsicsEstimate | Rejected]:
    """Estimates the intrinsics of all cameras of a rig from images over the whole recording.

    Unlike captures, the board may move: images are used one by one, and those in which it is blurred have larger
    residuals, by which they are rejected. Corners of tags are detected again in views that the first estimate
    rectifies.

    Args:
        rig: boards and cameras; other sensors and stated intrinsics do not matter.
        recording: open recording with the cameras' topics.
        engine: searches views.
        progress: called with the step and the fraction done.
        cache: has what earlier runs found in the images of a camera, and gets the others.

    Returns:
        By camera, the intrinsics, or why its images do not determine them.
    """
    cameras = rig.cameras()
    found: dict[str, IntrinsicsEstimate | Rejected] = {}
    for number, name in enumerate(cameras):

        def searching(share: float, number: int = number) -> None:
            progress("intrinsics", (number + share) / len(cameras))

        found[name] = _calibrate_camera(rig, name, recording, engine, searching, cache)
    return found


# Maximum number of images of a recording that calgraph intrinsics searches, spread evenly over it: four times
# max_views, as some show no board, or are blurred.
_MAX_IMAGES = 240


def _calibrate_camera(
    rig: Rig,
    name: str,
    recording: Recording,
    engine: Engine,
    progress: Callable[[float], None],
    cache: RecordingCache,
) -> IntrinsicsEstimate | Rejected:
    """The intrinsics of one camera; progress is called with the share done."""
    spec, settings = rig.cameras()[name], rig.settings.detection.camera
    timeline = build_timeline(recording.records([spec.topic]), recording.start, {name: spec.topic}, None)
    stamps = sample_evenly(np.unique(timeline.sensors[name].stamps), _MAX_IMAGES)
    frames = [Hold(i, stamp, stamp, {name: np.array([stamp])}) for i, stamp in enumerate(stamps.tolist())]
    marks = _find_marks(
        rig, {name: spec}, recording, timeline, frames, engine, lambda done: progress(0.5 * done), cache
    )[name]
    by_frame = _combine_views(rig, name, marks)
    estimate = estimate_intrinsics(rig, name, _list_views(by_frame), spec.lens_to_estimate)
    if isinstance(estimate, Rejected) or not any(board.tags for board in rig.boards):
        return estimate
    camera = estimate.camera
    captures = search_holds(
        detect_in_hold,
        {name: CameraDetector(rig.boards, camera, spec.noise, settings, found=_list_marks(marks)).find},
        select_messages(rig, recording, timeline, engine) or recording.records([spec.topic]),
        [frame for frame in frames if frame.index in by_frame],
        {name: spec.topic},
        engine=engine,
        progress=lambda done: progress(0.5 + done / (2 * len(by_frame))),
    )
    found = {one.capture: one.detections for one in captures if not isinstance(one.detections, Rejected)}
    views = [
        BoardView.from_corners(detection, (camera.width, camera.height))
        for _, detections in sorted(found.items())
        for detection in detections
        if isinstance(detection, BoardCorners)
    ]
    return estimate_intrinsics(rig, name, views, spec.lens_to_estimate)


def _combine_views(rig: Rig, name: str, marks: Mapping[int, Sequence[ImageMarks]]) -> dict[int, list[BoardView]]:
    """The views of boards by capture of one camera, of those that have some."""
    finder = BoardViewFinder(rig.boards, rig.cameras()[name].noise, rig.settings.detection.camera)
    views = {capture: finder.combine(found) for capture, found in marks.items()}
    return {capture: of_capture for capture, of_capture in views.items() if of_capture}


def _list_views(by_capture: Mapping[int, Sequence[BoardView]]) -> list[BoardView]:
    return [view for views in by_capture.values() for view in views]


def _list_marks(by_capture: Mapping[int, Sequence[ImageMarks]]) -> dict[float, tuple[Marks, ...]]:
    return {image.stamp: image.marks for found in by_capture.values() for image in found}


def _describe(estimate: IntrinsicsEstimate) -> str:
    """Model, number of views and fit; the values are those of the joint solution."""
    others = "".join(f"; {model}: {fit}" for model, fit in estimate.rejected_models.items())
    return f"{estimate.camera.model}, {len(estimate.detections)} views, RMS {estimate.noise:.2f} px{others}"


def find_intrinsics_remarks(
    rig: Rig, camera_infos: Mapping[str, str], intrinsics: EstimatedIntrinsics
) -> Iterator[Finding]:
    """Remarks on the intrinsics that were estimated, or could not be.

    Args:
        rig: the rig.
        camera_infos: topic with its intrinsics, by camera that has one.
        intrinsics: of the cameras without any.
    """
    for name in rig.cameras():
        without = name in intrinsics.estimates or name in intrinsics.failed
        if without and name in camera_infos and rig.cameras()[name].intrinsics is None:
            yield Finding(
                f"{camera_infos[name]} has no focal lengths, as the driver of {name} knows none: its intrinsics "
                "are estimated from this recording"
            )
        estimate = intrinsics.estimates.get(name)
        if estimate is None:
            continue
        yield Finding(f"the intrinsics of {name} were estimated from this recording: {_describe(estimate)}")
        for shortcoming in estimate.shortcomings:
            yield Finding(f"the intrinsics of {name} are not well determined: {shortcoming}")

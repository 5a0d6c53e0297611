"""What other processes compute of live messages: changes of views, backgrounds, and detections."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from calgraph.boards.detections import DetectionResult
from calgraph.config import CameraSpec, Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.rig.captures.detectors import learn_background, make_detectors
from calgraph.rig.captures.motion_detection import ActivityMeter, Signed
from calgraph.rig.captures.sensor_detection import detect_in_hold
from calgraph.rig.detection.board_views import BoardViewFinder
from calgraph.rig.kinds.rig_kind import Background, Detector
from calgraph.sensors import CameraModel, Message

NO_INTRINSICS = "its intrinsics are not known: no CameraInfo message with focal lengths has arrived"
"""Why a camera without intrinsics measures no pose while it is recorded."""
Decoder = Callable[[], Message]
# Detectors that a process keeps: those of captures and of pictures of some ten sensors.
_KEPT = 64


@dataclass(frozen=True)
class UnprojectedBoard(Rejected):
    """A camera without intrinsics detected the board: they are estimated from its views at the end."""

    pixels: tuple[tuple[float, float], ...] = ()
    """Where its corners were detected."""


def measure_changes(
    previous: Signed | None, decoders: Sequence[Decoder]
) -> tuple[list[float | Rejected], Signed | None]:
    """Measures the changes of consecutive messages, compared with ``previous`` and one another.

    Returns:
        The change of each, 0..1, or why its content is unusable; and what the next message is to be compared with.
    """
    meter = ActivityMeter(0.0, [previous] if previous else [])
    changes: list[float | Rejected] = []
    for decode in decoders:
        try:
            changes.append(float(np.nan_to_num(meter.measure_change(decode()))))
        except CalgraphError as error:
            changes.append(Rejected(str(error)))
    return changes, meter.recent[-1] if meter.recent else None


def learn_live_background(rig: Rig, name: str, decoders: Sequence[Decoder]) -> Background:
    """Learns what a scanner measures without target and operator; see :func:`learn_background`.

    Messages whose content is unusable are left out.
    """
    messages = []
    for decode in decoders:
        with suppress(CalgraphError):
            messages.append(decode())
    return learn_background(messages, rig.sensors[name].kind, rig.settings.detection)


@dataclass(frozen=True)
class DetectorInputs:
    """All that the detector of a sensor is made from, for other processes."""

    name: str
    """Of the sensor."""
    version: tuple[str, int, int]
    """Another one for each change of what follows."""
    rig: Rig = field(compare=False)
    """With this sensor only."""
    camera: CameraModel | None = field(compare=False)
    """Intrinsics of a camera; without any it detects no more than :class:`UnprojectedBoard`."""
    background: Background | None = field(compare=False)
    """Of a scanner, if one was learned."""
    seeds: Mapping[str, int] = field(compare=False)
    """By sensor; see :func:`calgraph.rig.captures.detectors.draw_seeds`."""


@lru_cache(maxsize=_KEPT)
def make_detector(inputs: DetectorInputs) -> Detector:
    """The detector; made once in each process."""
    rig, name = inputs.rig, inputs.name
    spec = rig.sensors[name]
    if isinstance(spec, CameraSpec) and inputs.camera is None:
        finder = BoardViewFinder(rig.boards, spec.noise, settings=rig.settings.detection.camera)
        return partial(_find_unprojected, finder)
    cameras = {name: inputs.camera} if inputs.camera else {}
    backgrounds = {name: inputs.background} if inputs.background else {}
    return make_detectors(rig, cameras, backgrounds, None, inputs.seeds)[name]


def _find_unprojected(finder: BoardViewFinder, messages: Sequence[Message]) -> Rejected:
    found = finder.find(messages)
    if isinstance(found, Rejected):
        return found
    pixels = np.concatenate([view.flat_pixels for view in found]).tolist()
    return UnprojectedBoard(NO_INTRINSICS, tuple(map(tuple, pixels)))


def detect_board(inputs: DetectorInputs, decoders: Sequence[Decoder]) -> DetectionResult:
    """The detections of one sensor in the messages of one capture.

    Raises:
        RecordingError: the content of a message is unusable.
        InputError: images do not have the size that the intrinsics are for.
    """
    return detect_in_hold({inputs.name: make_detector(inputs)}, 0, inputs.name, decoders, None).detections


def reduce_camera(camera: CameraModel, factor: int) -> CameraModel:
    """The intrinsics of images reduced by a whole factor; OpenCV's pixel convention."""
    K = camera.K / factor
    K[:2, 2] = (camera.K[:2, 2] + 0.5) / factor - 0.5
    K[2, 2] = 1.0
    return replace(
        camera, width=camera.width // factor, height=camera.height // factor, K=np.asarray(K, dtype=np.float64)
    )

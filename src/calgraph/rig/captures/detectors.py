"""The detector of every sensor of a rig, and the background models of its scanners."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from calgraph.boards.camera import PlaneEstimator
from calgraph.boards.tags import Marks
from calgraph.config import Rig
from calgraph.config.settings import DetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.recording import Recording
from calgraph.rig.captures.holds import Hold, sample_evenly
from calgraph.rig.detection.capture_background import CaptureBackground, learn_capture_background
from calgraph.rig.kinds import RIG_KINDS
from calgraph.rig.kinds.rig_kind import Background, Detector, DetectorInputs
from calgraph.sensors import CameraModel, Message, PointCloud, RecordedMessage
from calgraph.sensors.kinds import KINDS, RangeNoise


def learn_backgrounds(records: Iterable[RecordedMessage], rig: Rig) -> Mapping[str, Background | Rejected]:
    """Learns what the scanners measure in the background window, without target and operator.

    Returns:
        By scanner, or why there is none: it measured nothing in the window. Empty without a window.
    """
    by_topic = {spec.topic: name for name, spec in rig.sensors.items() if KINDS[spec.kind].measures_ranges}
    messages_by_sensor: dict[str, list[Message]] = {}
    for record in records:
        messages = messages_by_sensor.setdefault(by_topic[record.topic], [])
        if len(messages) < rig.settings.captures.max_background_messages:
            messages.append(record.decode())
    backgrounds: dict[str, Background | Rejected] = {}
    for name in by_topic.values() if rig.capture.background else ():
        try:
            backgrounds[name] = learn_background(
                messages_by_sensor.get(name, []), rig.sensors[name].kind, rig.settings.detection
            )
        except InputError as error:
            backgrounds[name] = Rejected(str(error))
    return backgrounds


def learn_background(messages: Sequence[Message], kind: str, settings: DetectionSettings) -> Background:
    """The background model of one scanner."""
    learn = RIG_KINDS[kind].learn_background
    assert learn is not None
    return learn(messages, settings)


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
    learned = {}
    for name, spec in rig.sensors.items():
        if name in without or not RIG_KINDS[spec.kind].learns_from_captures:
            continue
        assert isinstance(spec.noise, RangeNoise)
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
    marks: Mapping[str, Mapping[float, Sequence[Marks]]] = MappingProxyType({}),
) -> Mapping[str, Detector]:
    """The detector of each sensor.

    Args:
        rig: the rig.
        cameras: intrinsics by camera.
        backgrounds: by scanner; those without one search by size and shape.
        plane_estimator: estimates the plane of boards with tags in place of one PnP over all corners.
        seeds: of the detectors' samples, by sensor; see :func:`draw_seeds`.
        marks: by camera and stamp of an image that was searched before, what each finder found in it.
    """
    return {
        name: RIG_KINDS[spec.kind].make_detector(
            DetectorInputs(
                rig,
                name,
                cameras.get(name),
                backgrounds.get(name),
                plane_estimator,
                seeds[name],
                marks.get(name, {}),
            )
        )
        for name, spec in rig.sensors.items()
    }

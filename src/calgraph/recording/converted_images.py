"""A recording in which images are read as what they measured: those of depth cameras as clouds."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.recording.camera_info import resolve_intrinsics
from calgraph.recording.damage import wrap_errors
from calgraph.recording.recording import ClosedOnExit, JoinedRecording, Recording
from calgraph.sensors import CameraModel, Image, Message, RecordedMessage
from calgraph.sensors.kinds import KINDS, OpticalSpec

Conversion = Callable[[Image], Message]


class ConvertedRecording(ClosedOnExit):
    """A recording in which the images on some topics are read as other messages.

    Args:
        recording: with the images.
        conversions: by topic.
    """

    def __init__(self, recording: Recording, conversions: Mapping[str, Conversion]) -> None:
        self._recording, self._conversions = recording, conversions
        self.path, self.sources, self.topics = recording.path, recording.sources, recording.topics
        self.start, self.end = recording.start, recording.end

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of arrival; see :meth:`Recording.records`."""
        for record in self._recording.records(topics, start, end):
            convert = self._conversions.get(record.topic)
            yield replace(record, decode=partial(_decode, record, convert)) if convert else record

    def close(self) -> None:
        """Closes the files."""
        self._recording.close()


def convert_images(rig: Rig, recording: Recording) -> tuple[Rig, Recording]:
    """The rig with the intrinsics of its depth cameras, and the recording with clouds in place of their images.

    Both are unchanged where the rig has no depth camera.

    Raises:
        InputError: the intrinsics of a depth camera are not known.
    """
    converted = [name for name, spec in rig.sensors.items() if KINDS[spec.kind].convert]
    if not converted:
        return rig, recording
    resolved = resolve_intrinsics(rig, recording)
    specs = {name: resolved.sensors[name] for name in converted}
    rig = rig.model_copy(update={"sensors": {**rig.sensors, **specs}})
    conversions = {spec.topic: _find_conversion(name, rig) for name, spec in specs.items()}
    if isinstance(recording, JoinedRecording):  # whose parts may be of one pose each
        parts = [ConvertedRecording(part, conversions) for part in recording.parts]
        return rig, JoinedRecording(parts, recording.path)
    return rig, ConvertedRecording(recording, conversions)


def _find_conversion(name: str, rig: Rig) -> Conversion:
    spec = rig.sensors[name]
    convert = KINDS[spec.kind].convert
    assert convert is not None
    assert isinstance(spec, OpticalSpec)
    if spec.stated_intrinsics is None:
        raise InputError(
            f"sensors.{name}: a {KINDS[spec.kind].title} needs its intrinsics, and the recording has no "
            f"camera_info beside {spec.topic}; state camera_info (a topic) or intrinsics"
        )
    return partial(_call, convert, spec.stated_intrinsics.to_camera())


def _call(convert: Callable[[Image, CameraModel], Message], camera: CameraModel, image: Image) -> Message:
    return convert(image, camera)


def _decode(record: RecordedMessage, convert: Conversion) -> Message:
    message = record.decode()
    with wrap_errors(f"topic {record.topic}, stamp {record.stamp:.6f}"):
        if not isinstance(message, Image):
            raise ValueError(f"sends {type(message).__name__} messages; images are needed")
        return convert(message)

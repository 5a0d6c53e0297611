"""The intrinsics of a rig's cameras: from rig.yaml, or from the recording."""

import re

from calgraph.config import Intrinsics, Rig
from calgraph.errors import InputError, RecordingError
from calgraph.recording.camera_info import UncalibratedError
from calgraph.recording.recording import Recording
from calgraph.sensors import CameraInfo, CameraModel
from calgraph.sensors.kinds import OpticalSpec


def resolve_intrinsics(rig: Rig, recording: Recording) -> Rig:
    """The rig with the intrinsics stated of every sensor with a lens that has any.

    A camera with neither ``intrinsics`` nor ``camera_info`` takes those beside its images: in a plain folder its
    camera_info.yaml, in a bag the topic ``camera_info`` in the namespace of its images. A camera without any, or
    whose CameraInfo has no focal lengths, stays without: :func:`calgraph.calibrate_rig` estimates them.

    Raises:
        InputError: the stated topic holds no CameraInfo.
    """
    resolved = {
        name: spec.model_copy(update={"camera_info": None, "intrinsics": Intrinsics.from_camera(camera)})
        for name, spec in rig.sensors.items()
        if isinstance(spec, OpticalSpec)
        and spec.intrinsics is None
        and (camera := _read_camera(name, spec, recording))
    }
    return rig.model_copy(update={"sensors": {**rig.sensors, **resolved}})


def find_camera_infos(rig: Rig, recording: Recording) -> dict[str, str]:
    """The topic with its intrinsics, by camera whose intrinsics the rig does not state and that has one."""
    topics = {
        name: _find_camera_info(spec, recording) for name, spec in rig.cameras().items() if not spec.intrinsics
    }
    return {name: topic for name, topic in topics.items() if topic}


def list_camera_info_topics(spec: OpticalSpec) -> tuple[str, ...]:
    """The topics that may hold the intrinsics of a camera whose rig.yaml has none, the preferred one first."""
    if spec.camera_info:
        return (spec.camera_info,)
    images = re.sub("/compressed(Depth)?$", "", spec.topic)
    return f"{images}/camera_info", f"{images.rpartition('/')[0]}/camera_info"


def _find_camera_info(spec: OpticalSpec, recording: Recording) -> str | None:
    if spec.camera_info:
        return spec.camera_info
    available = {topic.name for topic in recording.topics}
    return next((topic for topic in list_camera_info_topics(spec) if topic in available), None)


def _read_camera(name: str, spec: OpticalSpec, recording: Recording) -> CameraModel | None:
    topic = _find_camera_info(spec, recording)
    if topic is None:
        return None
    try:
        message = next((r.decode() for r in recording.records([topic])), None)
    except RecordingError as error:
        if isinstance(error.__cause__, UncalibratedError):
            return None
        raise
    if not isinstance(message, CameraInfo):
        raise InputError(f"sensors.{name}.camera_info: topic {topic} holds no CameraInfo message")
    return message.camera

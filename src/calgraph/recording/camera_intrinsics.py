"""The intrinsics of a rig's cameras: from rig.yaml, or from the recording."""

from collections.abc import Mapping

from calgraph.config import Intrinsics, Rig
from calgraph.errors import InputError
from calgraph.recording.recording import Recording
from calgraph.sensors import CameraInfo, CameraModel


def read_cameras(rig: Rig, recording: Recording) -> Mapping[str, CameraModel]:
    """Intrinsics by camera.

    A camera with neither ``intrinsics`` nor ``camera_info`` takes those beside its images: in a plain folder its
    camera_info.yaml, in a bag the topic ``camera_info`` in the namespace of its images.

    Raises:
        InputError: a camera has no intrinsics anywhere.
    """
    cameras: dict[str, CameraModel] = {}
    stated = {topic.name for topic in recording.topics}
    for name, spec in rig.cameras().items():
        if spec.intrinsics is not None:
            cameras[name] = spec.intrinsics.camera()
            continue
        images = spec.topic.removesuffix("/compressed")
        beside = (f"{images}/camera_info", f"{images.rpartition('/')[0]}/camera_info")
        topic = spec.camera_info or next((t for t in beside if t in stated), None)
        if topic is None:
            raise InputError(
                f"sensors.{name}: has no intrinsics; give camera_info (a topic of the recording) or intrinsics "
                f"(model, width, height, K, distortion)"
            )
        message = next((r.decode() for r in recording.records([topic])), None)
        if not isinstance(message, CameraInfo):
            raise InputError(f"sensors.{name}.camera_info: topic {topic} holds no CameraInfo message")
        cameras[name] = message.camera
    return cameras


def with_intrinsics(rig: Rig, recording: Recording) -> Rig:
    """The rig with the intrinsics of every camera stated, wherever :func:`read_cameras` found them.

    Raises:
        InputError: a camera has no intrinsics anywhere.
    """
    sensors = dict(rig.sensors)
    for name, camera in read_cameras(rig, recording).items():
        intrinsics = Intrinsics(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            K=(*camera.focal.tolist(), *camera.principal_point.tolist()),
            distortion=tuple(camera.distortion.tolist()),
        )
        stated = {"camera_info": None, "intrinsics": intrinsics}
        sensors[name] = sensors[name].model_copy(update=stated)
    return rig.model_copy(update={"sensors": sensors})

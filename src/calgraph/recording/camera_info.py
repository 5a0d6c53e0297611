"""Camera intrinsics as ROS and YAML files spell them."""

import re
from collections.abc import Mapping
from itertools import islice
from typing import Any, Literal

import numpy as np

from calgraph.config import Intrinsics, Rig
from calgraph.errors import InputError, RecordingError
from calgraph.geometry import Array
from calgraph.recording.recording import Recording
from calgraph.sensors import CameraInfo, CameraModel, Message
from calgraph.sensors.kinds import OpticalSpec

# As the intrinsics of rig.yaml: the longest lenses have focal lengths of some 100,000 pixels.
_MAX_INTRINSIC = 1e6
MAX_UNCALIBRATED = 1000
"""Messages of zeros after which a camera is taken as not calibrated: drivers send them until they have loaded its
calibration, for seconds at 10 to 60 Hz. Reading on would take a pass over the recording."""
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_PINHOLE = ("plumb_bob", "rational_polynomial", "radtan", "pinhole", "none", "")


class UncalibratedError(ValueError):
    """A driver publishes a CameraInfo without focal lengths, because the camera is not calibrated."""


def camera_model(distortion_model: str, width: int, height: int, K: Array, D: Array) -> CameraModel:
    """A camera model from the values of a ROS CameraInfo.

    Args:
        distortion_model: ROS's name; ``fisheye``, ``radtan`` and ``pinhole`` are understood as well.
        width: of the image, pixels.
        height: of the image, pixels.
        K: (9,) or (3, 3) rows of the camera matrix, or (4,) fx, fy, cx, cy, pixels.
        D: (n,) distortion coefficients in OpenCV's order.

    Raises:
        UncalibratedError: the camera is not calibrated.
        ValueError: it has no image size, the model or a number of coefficients is not supported, or a value is
            beyond a million.
    """
    matrix = _camera_matrix(np.asarray(K, dtype=np.float64).ravel())
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise UncalibratedError(
            "K has no focal lengths: the camera is not calibrated; give its intrinsics in rig.yaml"
        )
    if width < 1 or height < 1:
        raise ValueError(
            f"states images of {width} x {height} pixels: the driver does not set their size; give the intrinsics "
            "in rig.yaml"
        )
    if max(np.abs(matrix).max(), np.abs(np.asarray(D, dtype=np.float64)).max(initial=0.0)) > _MAX_INTRINSIC:
        raise ValueError(
            f"K and distortion must not exceed {_MAX_INTRINSIC:g}, got {matrix.tolist()} and "
            f"{np.ravel(D)[:9].tolist()}"
        )
    model, distortion = _distortion(distortion_model.strip().lower(), np.asarray(D, dtype=np.float64).ravel())
    return CameraModel(model, int(width), int(height), matrix, distortion)


def camera_from_yaml(content: Mapping[str, Any], size: tuple[int, int] | None = None) -> CameraModel:
    """A camera model from a camera_info.yaml.

    Understands the keys of ROS's camera_calibration and of OpenCV's samples (``image_width``, ``camera_matrix:
    {data}``, ``M1``), those of the CameraInfo message (``width``, ``K``, ``D``), and what else programs call them
    (``cameraMatrix``, ``dist_coeffs``), in either case, with or without underscores.

    Args:
        content: of the file.
        size: width and height of the images, of files that do not state it.

    Raises:
        ValueError: a key is missing or has an unusable value.
    """
    keys = {str(key).lower().replace("_", ""): value for key, value in content.items()}
    if {"m1", "m2"} <= keys.keys():
        raise ValueError("has the matrices of two cameras, M1 and M2: leave those of this camera in its file")
    width, height = _first_of(keys, "image_size", "resolution", default=size or (None, None))
    model = _first_of(keys, "distortion_model", "camera_model", default="")
    return camera_model(
        "fisheye" if keys.get("fisheyemodel") else str(model),
        int(_first_of(keys, "width", "image_width", default=width)),
        int(_first_of(keys, "height", "image_height", default=height)),
        _numbers(_first_of(keys, "K", "camera_matrix", "mtx", "M", "M1", "M2")),
        _numbers(
            _first_of(
                keys, "D", "distortion_coefficients", "dist_coeffs", "distortion", "dist", "D1", "D2", default=[]
            )
        ),
    )


def _camera_matrix(K: Array) -> Array:
    if K.size not in (4, 9) or not np.isfinite(K).all():
        raise ValueError(f"K must have 9 finite values, got {K[:9].tolist()}")
    if K.size == 4:
        fx, fy, cx, cy = K
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return K.reshape(3, 3)


def _distortion(name: str, D: Array) -> tuple[Literal["pinhole", "fisheye"], Array]:
    if not np.isfinite(D).all():
        raise ValueError(f"distortion must be finite, got {D[:9].tolist()}")
    # As ROS's image_geometry does: no coefficient means none under any name, that of a fisheye included.
    if not D.any():
        return "pinhole", np.zeros(0)
    if name.startswith(_FISHEYE):
        if D.size > 4 and not D[4:].any():
            D = D[:4]
        if D.size != 4:
            raise ValueError(f"a fisheye camera has 4 distortion coefficients, got {D.size}")
        return "fisheye", D
    if name not in _PINHOLE:
        known = "plumb_bob, rational_polynomial, equidistant"
        raise ValueError(
            f"distortion model {name!r} is not supported; known are {known}: give intrinsics of one of these in "
            "rig.yaml, or intrinsics: estimate"
        )
    # Longer lists carry thin-prism and tilt terms; all-zero ones have no effect.
    if D.size > 8 and not D[8:].any():
        D = D[:8]
    if D.size not in (4, 5, 8):
        raise ValueError(f"a pinhole camera has 4, 5 or 8 distortion coefficients, got {D.size}")
    return "pinhole", D


def _numbers(value: Any) -> Array:
    """A list, nested or flat, or OpenCV's mapping with ``data``."""
    return np.asarray(value["data"] if isinstance(value, Mapping) else value, dtype=np.float64).ravel()


def _first_of(keys: Mapping[str, Any], *names: str, default: Any = None) -> Any:
    for name in names:
        if (value := keys.get(name.lower().replace("_", ""))) is not None:
            return value
    if default is None:
        raise ValueError(f"key {names[0]} (or {names[1]}) is missing")
    return default


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
    message: Message | None = None
    for record in islice(recording.records([topic]), MAX_UNCALIBRATED):
        try:
            message = record.decode()
            break
        except RecordingError as error:
            if not isinstance(error.__cause__, UncalibratedError):
                raise
    else:
        return None
    if not isinstance(message, CameraInfo):
        raise InputError(f"sensors.{name}.camera_info: topic {topic} holds no CameraInfo message")
    return message.camera

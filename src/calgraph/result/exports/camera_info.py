"""Intrinsics as the camera_info.yaml of ROS's camera_calibration and camera_info_manager."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.io.text_writing import flow_sequence, format_yaml
from calgraph.result.calibrated_cameras import find_intrinsics
from calgraph.result.calibration import Calibration
from calgraph.sensors import CameraModel

_COMMENT = "Intrinsics of {name}, estimated by calgraph. The projection matrix is that of unrectified images."


def to_camera_info(name: str, camera: CameraModel) -> str:
    """The text of a camera_info.yaml.

    Args:
        name: of the camera.
        camera: its intrinsics: plumb_bob with up to 5 coefficients, rational_polynomial with 8, or equidistant.
    """
    if camera.model == "fisheye":
        model, distortion = "equidistant", camera.distortion.tolist() or [0.0] * 4
    else:
        distortion = camera.distortion.tolist() + [0.0] * max(5 - len(camera.distortion), 0)
        model = "plumb_bob" if len(distortion) == 5 else "rational_polynomial"
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(camera.K),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([camera.K, np.zeros(3)])),
    }
    return format_yaml(content, _COMMENT.format(name=repr(name)))


def to_camera_infos(calibration: Calibration, rig: Rig | None, cameras: Mapping[str, CameraModel]) -> str:
    """The text of the cameras of a calibration, a YAML document for each.

    Args:
        calibration: names of the cameras, and estimated intrinsics.
        rig: intrinsics as rig.yaml states them.
        cameras: intrinsics by sensor; they take precedence over those of the rig.

    Raises:
        InputError: there is no camera, or the intrinsics of one are not known.
    """
    models = find_intrinsics(calibration, rig, cameras)
    return "---\n".join(to_camera_info(name, camera) for name, camera in models.items())


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": flow_sequence(float(value) for value in values.ravel())}

"""The cameras of a rig as a Kalibr camchain."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.io.text_writing import flow_sequence, format_yaml
from calgraph.result.calibrated_cameras import find_intrinsics
from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import format_coordinate
from calgraph.sensors import CameraModel

# Pixels along either axis of the image at which radtan is fitted to another model.
_GRID = 20
# Largest difference of the pixels of both, px: half of one, several times the noise of corners.
_MAX_DIFFERENCE = 0.5

_COMMENT = "Kalibr camchain, calibrated by calgraph. T_cn_cnm1 maps coordinates in the camera before to this one."


def to_camchain(calibration: Calibration, rig: Rig | None, cameras: Mapping[str, CameraModel]) -> str:
    """The text of a camchain with the cameras in the order of the calibration.

    Kalibr knows pinhole cameras with its distortion models ``radtan`` (k1 k2 p1 p2), ``equidistant`` and ``none``.
    Pinhole cameras with more coefficients have the nearest ``radtan``.

    Args:
        calibration: the poses.
        rig: topics of the cameras, and intrinsics, as estimated or as rig.yaml states them.
        cameras: intrinsics by sensor; they take precedence over those of the rig.

    Raises:
        InputError: there is no camera, or the intrinsics of one are not known, or more than half a pixel off any
            kind that Kalibr has.
    """
    models = find_intrinsics(calibration, rig, cameras)
    names, specs = list(models), rig.cameras() if rig else {}
    chain: dict[str, Any] = {}
    for index, name in enumerate(names):
        entry: dict[str, Any] = {"cam_overlaps": flow_sequence(i for i in range(len(names)) if i != index)}
        if index > 0:
            entry["T_cn_cnm1"] = _matrix(calibration.transform(name, names[index - 1]))
        entry |= _intrinsics(name, models[name])
        if name in specs:
            entry["rostopic"] = specs[name].topic
        chain[f"cam{index}"] = entry
    return format_yaml(chain, "\n".join([_COMMENT, *(f"cam{i}: {name!r}" for i, name in enumerate(names))]))


def to_single_camchain(name: str, camera: CameraModel, topic: str) -> str:
    """The text of a camchain with one camera.

    Args:
        name: of the camera.
        camera: its intrinsics.
        topic: of its images.

    Raises:
        InputError: its model is more than half a pixel off any kind that Kalibr has.
    """
    entry = {"cam_overlaps": flow_sequence([]), **_intrinsics(name, camera), "rostopic": topic}
    return format_yaml({"cam0": entry}, f"Kalibr camchain, intrinsics estimated by calgraph.\ncam0: {name!r}")


def _intrinsics(name: str, camera: CameraModel) -> dict[str, Any]:
    K = camera.K
    model, coefficients = _distortion(name, camera)
    return {
        "camera_model": "pinhole",
        "distortion_coeffs": flow_sequence(coefficients),
        "distortion_model": model,
        "intrinsics": flow_sequence(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])),
        "resolution": flow_sequence([camera.width, camera.height]),
    }


def _distortion(name: str, camera: CameraModel) -> tuple[str, list[float]]:
    coefficients = camera.distortion.tolist()
    if camera.model == "fisheye":
        return "equidistant", coefficients or [0.0] * 4
    if np.any(camera.distortion[4:]):
        return "radtan", _fit_radtan(name, camera)
    return ("radtan", coefficients[:4]) if coefficients else ("none", [])


def _fit_radtan(name: str, camera: CameraModel) -> list[float]:
    """k1, k2, p1 and p2 that project nearest to a camera with more coefficients, such as an estimated k3."""
    x, y = np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID)
    rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = rays[np.isfinite(rays[:, 0])]
    radtan = replace(camera, distortion=np.zeros(4))
    effect = camera.project(rays) - radtan.project(rays)
    by_coefficients = radtan.project_by_intrinsics(rays)[..., 4:].reshape(-1, 4)
    fitted, *_ = np.linalg.lstsq(by_coefficients, effect.ravel())
    if np.abs(by_coefficients @ fitted - effect.ravel()).max() > _MAX_DIFFERENCE:
        raise InputError(
            f"Kalibr has no distortion model for {name!r}: its radtan ends at k1 k2 p1 p2, "
            f"this camera has {len(camera.distortion)} coefficients"
        )
    return [float(value) for value in fitted]


def _matrix(T: Array) -> list[Any]:
    return [flow_sequence(float(format_coordinate(value)) for value in row) for row in T]

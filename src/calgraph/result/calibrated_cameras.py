"""The intrinsics that belong to a calibration's poses."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.result.calibration import Calibration
from calgraph.sensors import DISTORTION_NAMES, CameraModel


def calibrated_cameras(calibration: Calibration, rig: Rig) -> Mapping[str, CameraModel]:
    """Camera models by sensor, with the estimated intrinsics where there are."""
    return {name: _apply_estimates(calibration, name, camera) for name, camera in rig.camera_models().items()}


def _apply_estimates(calibration: Calibration, name: str, camera: CameraModel) -> CameraModel:
    values = {one.quantity: one.value for one in calibration.systematic if one.of == name}
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.principal_point.tolist()
    stated_aspect = fx / fy
    aspect = values.get("pixel aspect", stated_aspect) / stated_aspect - 1
    focal = values.get("focal length", (fx + fy) / 2) / ((fx + fy) / 2) + aspect * np.array([0.5, -0.5])
    names = DISTORTION_NAMES[camera.model]
    count = max(len(camera.distortion), *(i + 1 for i, one in enumerate(names) if one in values), 0)
    stated = np.append(camera.distortion, np.zeros(count - len(camera.distortion)))
    distortion = [values.get(quantity, value) for quantity, value in zip(names, stated.tolist(), strict=False)]
    center = [values.get("cx", cx), values.get("cy", cy)]
    return camera.with_intrinsics(np.concatenate([camera.focal * focal, center, distortion]))

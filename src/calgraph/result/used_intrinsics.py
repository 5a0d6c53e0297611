"""The intrinsics that a calibration goes with."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.result.calibration import Calibration
from calgraph.sensors import CameraModel


def calibrated_cameras(calibration: Calibration, rig: Rig) -> Mapping[str, CameraModel]:
    """By camera its intrinsics, the estimated ones where they were; none of those that nobody states."""
    stated = {name: spec.intrinsics.camera() for name, spec in rig.cameras().items() if spec.intrinsics}
    return {name: _apply_estimates(calibration, name, camera) for name, camera in stated.items()}


def _apply_estimates(calibration: Calibration, name: str, camera: CameraModel) -> CameraModel:
    values = np.array([one.value for one in calibration.estimated_parameters if one.of == name])
    return camera.with_intrinsics(values) if len(values) == len(camera.intrinsics) else camera

"""The intrinsics that belong to a calibration's poses."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.result.calibration import Calibration
from calgraph.sensors import CameraModel


def calibrated_cameras(calibration: Calibration, rig: Rig) -> Mapping[str, CameraModel]:
    """Camera models by sensor, with the estimated intrinsics if any, else with those stated in the rig."""
    return {name: _apply_estimates(calibration, name, camera) for name, camera in rig.camera_models().items()}


def _apply_estimates(calibration: Calibration, name: str, camera: CameraModel) -> CameraModel:
    values = np.array([one.value for one in calibration.estimated_parameters if one.of == name])
    return camera.with_intrinsics(values) if len(values) == len(camera.intrinsics) else camera

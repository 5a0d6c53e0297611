"""Intrinsics that were estimated from a recording, as rig.yaml states them."""

import numpy as np

from calgraph.config import CameraSpec, CameraUncertainty, Intrinsics
from calgraph.config.settings import IntrinsicsSettings


def state_intrinsics(spec: CameraSpec, intrinsics: Intrinsics, settings: IntrinsicsSettings) -> CameraSpec:
    """A camera of a rig with intrinsics that were estimated from the recording, of which nothing else is known.

    Its priors are those of unknown intrinsics: the same views are part of the joint solution, so the covariance of
    the estimate must not be its prior.

    Args:
        spec: the camera.
        intrinsics: the estimated ones.
        settings: the priors of unknown intrinsics.
    """
    diagonal = float(np.hypot(intrinsics.width, intrinsics.height))
    unknown = CameraUncertainty(
        focal_length=settings.focal_length_stddev,
        pixel_aspect=settings.pixel_aspect_stddev,
        principal_point=settings.principal_point_stddev * diagonal,
        distortion=settings.distortion_stddev * diagonal,
    )
    return spec.model_copy(update={"camera_info": None, "intrinsics": intrinsics, "uncertainty": unknown})

"""Intrinsics that were estimated from a recording, as rig.yaml states them."""

import numpy as np

from calgraph.config import CameraSpec, CameraUncertainty, Intrinsics

# Prior standard deviation of an unknown focal length, relative to the start value of the joint solution: no
# information.
_FOCAL_LENGTH_STDDEV = 0.5
# The same of the pixel aspect: sensors have square pixels, but drivers scale images to even sizes.
_PIXEL_ASPECT_STDDEV = 0.02
# The same of the principal point along each axis, in diagonals of the image: cropped images.
_PRINCIPAL_POINT_STDDEV = 0.25
# The same of each distortion coefficient, in diagonals of the image, at its corner: no information.
_DISTORTION_STDDEV = 1.0


def state_intrinsics(spec: CameraSpec, intrinsics: Intrinsics) -> CameraSpec:
    """A camera of a rig with intrinsics that were estimated from the recording, of which nothing else is known.

    Its priors are those of unknown intrinsics: the same views are part of the joint solution, so the covariance of
    the estimate must not be its prior.

    Args:
        spec: the camera.
        intrinsics: the estimated ones.
    """
    diagonal = float(np.hypot(intrinsics.width, intrinsics.height))
    unknown = CameraUncertainty(
        focal_length=_FOCAL_LENGTH_STDDEV,
        pixel_aspect=_PIXEL_ASPECT_STDDEV,
        principal_point=_PRINCIPAL_POINT_STDDEV * diagonal,
        distortion=_DISTORTION_STDDEV * diagonal,
    )
    return spec.model_copy(update={"camera_info": None, "intrinsics": intrinsics, "uncertainty": unknown})

"""Errors of a camera's intrinsics and readout as parameters, with the priors of rig.yaml."""

import numpy as np

from calgraph.sensors import DISTORTION_NAMES, CameraModel
from calgraph.sensors.kinds.camera import CameraUncertainty
from calgraph.sensors.lens_errors import displacement_at_corner
from calgraph.verdict.parameter_estimates import PriorParameter

# Least displacement by a distortion coefficient, pixels: images that are a point have none.
_LEAST_EFFECT = 1e-9


def list_lens_errors(name: str, camera: CameraModel, prior: CameraUncertainty) -> list[PriorParameter]:
    """The errors (4 + n) of the intrinsics of a camera, as :func:`calgraph.sensors.lens_errors.adjust_camera`."""
    (fx, fy), centre = camera.focal.tolist(), camera.principal_point.tolist()
    mean = (fx + fy) / 2
    effects = np.maximum(displacement_at_corner(camera), _LEAST_EFFECT).tolist()
    names = DISTORTION_NAMES[camera.model]
    return [
        PriorParameter(
            name, "focal length", "px", prior.focal_length, stated=mean, scale=mean,
            clause="the focal length of {of} is {size} longer|shorter than stated",
        ),
        PriorParameter(
            name, "pixel aspect", "", prior.pixel_aspect, stated=fx / fy, scale=fx / fy,
            clause="pixels of {of} are {size} narrower|wider for their height than stated",
        ),
        *(
            PriorParameter(name, quantity, "px", prior.principal_point, stated=stated)
            for quantity, stated in zip(("cx", "cy"), centre, strict=True)
        ),
        *(
            PriorParameter(name, quantity, "", prior.distortion / effect, stated=stated)
            for quantity, stated, effect in zip(names, camera.distortion.tolist(), effects, strict=False)
        ),
    ]  # fmt: skip


def readout_error(name: str, prior: CameraUncertainty) -> PriorParameter:
    """The time from the first to the last row of an image."""
    clause = "{of} reads the last row of an image {size} later|earlier than stated"
    return PriorParameter(name, "readout time", "s", prior.readout_time, clause=clause)

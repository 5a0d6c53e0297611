"""The intrinsics that belong to a calibration's poses."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.config import CameraSpec, CameraUncertainty, Intrinsics, Rig
from calgraph.errors import InputError
from calgraph.result.calibration import Calibration
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.sensors import DISTORTION_NAMES, CameraModel
from calgraph.sensors.kinds import KINDS


def calibrated_cameras(calibration: Calibration, rig: Rig) -> Mapping[str, CameraModel]:
    """Camera models by sensor, with the estimated intrinsics where there are."""
    return {
        name: apply_estimates(calibration.systematic, name, camera) for name, camera in rig.camera_models().items()
    }


def find_intrinsics(
    calibration: Calibration, rig: Rig | None, cameras: Mapping[str, CameraModel]
) -> dict[str, CameraModel]:
    """The intrinsics of all cameras of a calibration, for a file of another program.

    Args:
        calibration: names of the cameras, and estimated intrinsics.
        rig: with stated intrinsics.
        cameras: intrinsics by sensor; they take precedence over those of the rig.

    Raises:
        InputError: there is no camera, or the intrinsics of one are not known.
    """
    known = {**(calibrated_cameras(calibration, rig) if rig else {}), **cameras}
    names = [sensor.name for sensor in calibration.sensors if KINDS[sensor.kind].detects == "corners"]
    if not names:
        raise InputError("a file of intrinsics needs a camera, this calibration has none")
    for name in names:
        if name not in known:
            raise InputError(
                f"the intrinsics of {name!r} are not known; state them in rig.yaml (sensors.{name}.intrinsics)"
            )
    return {name: known[name] for name in names}


def state_calibrated_intrinsics(rig: Rig, calibration: Calibration) -> Rig:
    """The rig with the intrinsics of cameras that the calibration has estimated from the recording alone."""
    estimated = {
        sensor.name: state_intrinsics(rig.cameras()[sensor.name], sensor.intrinsics)
        for sensor in calibration.sensors
        if sensor.intrinsics is not None
    }
    return rig.model_copy(update={"sensors": {**rig.sensors, **estimated}})


def apply_estimates(systematic: Sequence[EstimatedParameter], name: str, camera: CameraModel) -> CameraModel:
    """A camera with the intrinsics among the systematic parameters of a calibration.

    Args:
        systematic: all parameters.
        name: of the camera.
        camera: with its stated intrinsics.
    """
    values = {one.quantity: one.value for one in systematic if one.of == name}
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

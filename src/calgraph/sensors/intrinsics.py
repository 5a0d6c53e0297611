"""A camera's intrinsics as rig.yaml states them."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from calgraph.io.quantities import MAX_PIXELS, PixelSigma
from calgraph.io.strict_model import StrictModel, invalid, limit_to
from calgraph.sensors.camera_model import CameraModel

# The largest sensors have 20,000 pixels a side, and the longest lenses focal lengths of some 100,000.
PixelCount = Annotated[int, Strict(), Field(ge=1, le=65_536)]
PixelLength = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False), limit_to(1e6, "pixels")]
Coefficient = Annotated[float, Strict(), Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Intrinsics(StrictModel):
    """A camera's intrinsics, as :class:`calgraph.sensors.CameraModel` explains them."""

    model: Literal["pinhole", "fisheye"] = "pinhole"
    """``fisheye`` is OpenCV's equidistant model."""
    width: PixelCount
    """Pixels."""
    height: PixelCount
    """Pixels."""
    K: tuple[PixelLength, PixelLength, Coefficient, Coefficient]
    """fx, fy, cx, cy, pixels."""
    distortion: tuple[Coefficient, ...] = ()
    """OpenCV's coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 to k4 for fisheye; none for no distortion."""
    estimated_from_views: Annotated[int, Strict(), Field(ge=1)] | None = None
    """Number of views of the recording that they were estimated from; left out where they are stated."""
    model_error: PixelSigma | None = None
    """RMS displacement of pixels that the model of the lens does not have, estimated with them."""

    @model_validator(mode="after")
    def _known_length(self) -> "Intrinsics":
        lengths = (0, 4) if self.model == "fisheye" else (0, 4, 5, 8)
        if len(self.distortion) not in lengths:
            allowed = f"{', '.join(map(str, lengths[:-1]))} or {lengths[-1]}"
            raise invalid("distortion", f"{self.model} has {allowed} coefficients, got {len(self.distortion)}")
        return self

    @classmethod
    def from_camera(
        cls, camera: CameraModel, estimated_from_views: int | None = None, model_error: float = 0.0
    ) -> "Intrinsics":
        """The intrinsics of a camera model; an error of the model of 0 is left out."""
        return cls(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            K=(*camera.focal.tolist(), *camera.principal_point.tolist()),
            distortion=tuple(camera.distortion.tolist()),
            estimated_from_views=estimated_from_views,
            model_error=min(model_error, MAX_PIXELS) or None,
        )

    def to_camera(self) -> CameraModel:
        """The camera model with these intrinsics."""
        fx, fy, cx, cy = self.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return CameraModel(self.model, self.width, self.height, K, np.array(self.distortion))

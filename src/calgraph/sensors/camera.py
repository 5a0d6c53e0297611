"""Camera models: pinhole with OpenCV's distortion polynomials, and OpenCV's fisheye (equidistant) model.

Pixel coordinates follow OpenCV: the centre of the top-left pixel is (0, 0).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Intrinsics of one camera in its optical frame (z forward, x right, y down)."""

    model: Literal["pinhole", "fisheye"]
    """``pinhole``: plumb_bob (4 or 5 coefficients) or rational polynomial (8); ``fisheye``: equidistant (4)."""
    width: int
    height: int
    K: Array
    """(3, 3): fx, fy, cx, cy in pixels."""
    distortion: Array
    """(0,), (4,), (5,) or (8,) in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6, or (4,) k1..k4 for fisheye."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.array(self.K, dtype=np.float64).reshape(3, 3))
        object.__setattr__(self, "distortion", np.array(self.distortion, dtype=np.float64).ravel())
        self.K.setflags(write=False)
        self.distortion.setflags(write=False)

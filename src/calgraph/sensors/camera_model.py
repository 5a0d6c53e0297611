"""Camera models: pinhole with OpenCV's distortion polynomials, and OpenCV's fisheye (equidistant) model.

Pixel coordinates follow OpenCV: the centre of the top-left pixel is (0, 0).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import lens
from calgraph.sensors.lens import Lens

_COEFFICIENT_COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
DISTORTION_NAMES = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_MAX_ROUND_TRIP_ERROR = 1e-8
"""A ray is valid if it projects back to its pixel within this distance, pixels."""


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
        object.__setattr__(self, "distortion", _trim_coefficients(self.model, np.ravel(self.distortion)))
        self.K.setflags(write=False)
        self.distortion.setflags(write=False)

    @property
    def focal(self) -> Array:
        """(2,) fx, fy, pixels."""
        return self.K[[0, 1], [0, 1]]

    @property
    def principal_point(self) -> Array:
        """(2,) cx, cy, pixels."""
        return self.K[:2, 2]

    @cached_property
    def lens(self) -> Lens:
        """The distortion model, applied before ``K`` scales normalized coordinates to pixels."""
        return (
            lens.pinhole_lens(self.distortion) if self.model == "pinhole" else lens.fisheye_lens(self.distortion)
        )

    def project(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 3), m, in the camera's frame.

        NaN where the model is not defined: behind the camera (a fisheye's field of view may exceed 90° from the
        axis), and beyond the angle where the distortion polynomial is no longer monotonic and would project points
        outside the field of view into the image. Other pixels may lie outside the image; see :meth:`contains`.
        """
        return self.focal * self.lens.distort(np.asarray(points, dtype=np.float64))[0] + self.principal_point

    def project_with_jacobian(self, points: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) as :meth:`project` gives them, and their derivatives (N, 2, 3) by the points, pixels/m."""
        distorted, J = self.lens.distort(np.asarray(points, dtype=np.float64))
        return self.focal * distorted + self.principal_point, self.focal[:, None] * J

    @property
    def intrinsics(self) -> Array:
        """(4 + n,) fx, fy, cx, cy, pixels, and the coefficients of the distortion."""
        return np.concatenate([self.focal, self.principal_point, self.distortion])

    def with_intrinsics(self, intrinsics: Array) -> "CameraModel":
        """Returns the camera with other ``intrinsics`` (4 + n,)."""
        K = np.eye(3)
        K[[0, 1, 0, 1], [0, 1, 2, 2]] = intrinsics[:4]
        return replace(self, K=K, distortion=intrinsics[4:])

    def project_by_intrinsics(self, points: Array) -> Array:
        """Derivatives (N, 2, 4 + n) of the pixels of points (N, 3) by ``intrinsics``."""
        distorted, _ = self.lens.distort(points)
        by_coefficients = self.lens.distort_by_coefficients(points)[..., : len(self.distortion)]
        principal = np.broadcast_to(np.eye(2), (len(points), 2, 2))
        return np.concatenate(
            [distorted[:, None] * np.eye(2), principal, self.focal[:, None] * by_coefficients], axis=-1
        )

    def rays(self, pixels: Array) -> Array:
        """Unit vectors (N, 3) from the camera's centre through pixels (N, 2); NaN where no point projects there.

        Solved by Newton's method to rounding errors: projecting a ray gives its pixel back.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        rays = self.lens.undistort((pixels - self.principal_point) / self.focal)
        # Comparisons with NaN are False, so rays without a projection are invalid.
        found = np.abs(self.project(rays) - pixels).max(axis=-1, initial=0) < _MAX_ROUND_TRIP_ERROR
        return np.where(found[:, None], rays, np.nan)

    def contains(self, pixels: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """(N,) mask of pixels (N, 2) in the image, up to the outer edge of its border pixels; False for NaN."""
        inside = (pixels >= -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)
        return np.asarray(inside.all(axis=-1), dtype=np.bool_)


def _trim_coefficients(model: str, distortion: Array) -> Array:
    """Copies the coefficients, without trailing zeros for terms that the model does not have.

    Some drivers pad: 12 or 14 coefficients with zero thin-prism and tilt terms are a rational polynomial.

    Raises:
        InputError: the number of coefficients is not supported, or one is not finite.
    """
    allowed = _COEFFICIENT_COUNTS[model]
    coefficients = np.array(distortion, dtype=np.float64)
    if len(coefficients) > allowed[-1] and not coefficients[allowed[-1] :].any():
        coefficients = coefficients[: allowed[-1]].copy()
    if len(coefficients) not in allowed or not np.isfinite(coefficients).all():
        raise InputError(
            f"distortion of a {model} camera: {' or '.join(map(str, allowed))} finite coefficients are supported, "
            f"got {np.array2string(coefficients, separator=', ')}"
        )
    return coefficients

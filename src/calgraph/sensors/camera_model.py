"""Camera models: pinhole with OpenCV's distortion polynomials, and OpenCV's fisheye (equidistant) model.

Pixel coordinates follow OpenCV: the centre of the top-left pixel is (0, 0).

A lens maps a point in the camera's frame to *distorted* normalized coordinates, before focal length and principal
point. Both models have a radial profile that grows with the angle from the axis up to a *limit*; beyond it the
polynomial is not monotonic, and the model is not valid. Source: OpenCV 4, "Camera Calibration and 3D
Reconstruction", and Kannala and Brandt, "A generic camera model and calibration method", PAMI 2006.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array

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
        return self.K.diagonal()[:2]

    @property
    def principal_point(self) -> Array:
        """(2,) cx, cy, pixels."""
        return self.K[:2, 2]

    @cached_property
    def lens(self) -> "Lens":
        """The distortion model, applied before ``K`` scales normalized coordinates to pixels."""
        return pinhole_lens(self.distortion) if self.model == "pinhole" else fisheye_lens(self.distortion)

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


_MAX_PINHOLE_ANGLE = np.deg2rad(89.9)
"""Largest angle from the axis of a pinhole model, rad: its coordinates are tan(angle), which diverges at 90°."""
# Largest angle from the axis of a fisheye model, rad: at half a turn the direction around the axis is undefined.
_MAX_FISHEYE_ANGLE = np.pi - 1e-6
_MAX_ITERATIONS = 25
"""Limit on Newton steps: 3 to 5 suffice except near the limit, where the derivative vanishes."""
_CONVERGENCE_STEP = 1e-14
"""Newton's steps end below this, in tangents of angles: rounding of numbers near 1."""
_TABLE_SIZE = 256
"""Angles of the table of start values: its error is within the convergence of Newton's method."""
_SMALLEST_SQUARE = 1e-300
"""Least squared radius, by whose root is divided: keeps the quotient finite on the axis."""


class Lens(Protocol):
    """Interface of distortion models."""

    def distort(self, points: Array) -> tuple[Array, Array]:
        """Distorted coordinates (N, 2) of points (N, 3) and their derivatives (N, 2, 3); NaN beyond the limit."""

    def distort_by_coefficients(self, points: Array) -> Array:
        """Derivatives (N, 2, n) of the distorted coordinates of points (N, 3) by the model's n coefficients."""

    def undistort(self, distorted: Array) -> Array:
        """Unit vectors (N, 3) of distorted coordinates (N, 2); beyond the limit any value."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Rational radial and tangential distortion."""

    k: Array
    """(8,) k1 k2 p1 p2 k3 k4 k5 k6."""
    limit: float
    """Largest undistorted radius up to which the radial profile is monotonic."""

    def distort(self, points: Array) -> tuple[Array, Array]:
        """See :class:`Lens`."""
        z = points[:, 2]
        front = z > 0
        depth = np.where(front, z, 1.0)[:, None]
        undistorted = points[:, :2] / depth
        # Multiplied by the depth, so that points near the image plane at z = 0 do not overflow.
        inside = front & (np.hypot(points[:, 0], points[:, 1]) < self.limit * depth[:, 0])
        undistorted = np.where(inside[:, None], undistorted, np.nan)
        distorted, D = self._distort_normalized(undistorted)
        J = np.concatenate([D, -D @ undistorted[:, :, None]], axis=-1) / depth[:, :, None]
        # Tangential terms shift the limit a little: beyond it the determinant is negative.
        monotonic = _determinant(D) > 0
        return np.where(monotonic[:, None], distorted, np.nan), np.where(monotonic[:, None, None], J, np.nan)

    def distort_by_coefficients(self, points: Array) -> Array:
        """See :class:`Lens`; n = 8."""
        x, y = (points[:, :2] / points[:, 2:]).T
        s = x * x + y * y
        _, _, _, _, _, k4, k5, k6 = self.k
        c, den = self._radial(s)[0], 1 + s * (k4 + s * (k5 + s * k6))
        powers = np.stack([s, s**2, s**3], axis=-1) / den[:, None]
        radial = powers[:, None] * np.stack([x, y], axis=-1)[..., None]
        tangential = np.stack(
            [np.stack([2 * x * y, s + 2 * x * x], axis=-1), np.stack([s + 2 * y * y, 2 * x * y], axis=-1)], axis=1
        )
        return np.concatenate([radial[..., :2], tangential, radial[..., 2:], -c[:, None, None] * radial], axis=-1)

    def undistort(self, distorted: Array) -> Array:
        """See :class:`Lens`."""
        max_angle = min(np.arctan(self.limit), _MAX_PINHOLE_ANGLE)
        radii = np.tan(np.linspace(0, max_angle, _TABLE_SIZE))
        undistorted = _interpolate_radial_inverse(distorted, radii, radii * self._radial(radii**2)[0])
        for _ in range(_MAX_ITERATIONS):
            value, D = self._distort_normalized(undistorted)
            determinant = _determinant(D)
            determinant = np.where(np.abs(determinant) > 1e-12, determinant, 1e-12)
            (ex, ey) = (value - distorted).T
            step = np.stack([D[:, 1, 1] * ex - D[:, 0, 1] * ey, D[:, 0, 0] * ey - D[:, 1, 0] * ex], axis=-1)
            undistorted, before = _clip_radius(undistorted - step / determinant[:, None], radii[-1]), undistorted
            if not np.any(np.abs(undistorted - before) > _CONVERGENCE_STEP * (1 + np.abs(undistorted))):
                break
        return _normalize(np.concatenate([undistorted, np.ones((len(undistorted), 1))], axis=-1))

    def _radial(self, s: Array) -> tuple[Array, Array]:
        """The radial factor at squared radii ``s``, and its derivative by ``s``."""
        k1, k2, _, _, k3, k4, k5, k6 = self.k
        num, den = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
        num_slope, den_slope = k1 + s * (2 * k2 + s * 3 * k3), k4 + s * (2 * k5 + s * 3 * k6)
        return num / den, (num_slope - num / den * den_slope) / den

    def _distort_normalized(self, undistorted: Array) -> tuple[Array, Array]:
        """Distorted coordinates (N, 2) of undistorted ones (N, 2), and their derivatives (N, 2, 2)."""
        p1, p2 = self.k[2:4]
        x, y = undistorted.T
        s = x * x + y * y
        c, slope = self._radial(s)
        # Filled in place: with np.stack, the poses of boards take a fifth longer.
        distorted, D = np.empty(undistorted.shape), np.empty((len(x), 2, 2))
        distorted[:, 0] = c * x + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        distorted[:, 1] = c * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        D[:, 0, 1] = D[:, 1, 0] = 2 * (slope * x * y + p1 * x + p2 * y)
        D[:, 0, 0] = c + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
        D[:, 1, 1] = c + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
        return distorted, D


@dataclass(frozen=True, eq=False)
class Fisheye:
    """Distance from the principal point as an odd polynomial of the angle from the axis."""

    k: Array
    """(4,) k1 k2 k3 k4."""
    limit: float
    """Largest angle from the axis up to which the profile is monotonic, rad."""

    def distort(self, points: Array) -> tuple[Array, Array]:
        """See :class:`Lens`."""
        x, y, z = points.T
        r2 = x * x + y * y
        r = np.sqrt(r2)
        angle = np.arctan2(r, z)
        angle = np.where(angle < self.limit, angle, np.nan)
        value, slope = self._profile(angle)
        rho2 = np.maximum(r2 + z * z, _SMALLEST_SQUARE)
        # On the axis profile / radius tends to 1/z, and terms divided by r2 are multiplied by zero.
        on_axis = r2 < _SMALLEST_SQUARE
        scale = np.where(on_axis, 1 / np.where(on_axis & (z > 0), z, 1.0), value / np.where(on_axis, 1.0, r))
        bulge = np.where(on_axis, 0.0, (slope * z / rho2 - scale) / np.where(on_axis, 1.0, r2))
        scale = np.where(np.isfinite(angle) & (rho2 > _SMALLEST_SQUARE), scale, np.nan)
        along = -slope / rho2
        J = np.empty((len(points), 2, 3))
        J[:, 0, 0], J[:, 1, 1] = scale + bulge * x * x, scale + bulge * y * y
        J[:, 0, 1] = J[:, 1, 0] = bulge * x * y
        J[:, 0, 2], J[:, 1, 2] = along * x, along * y
        return scale[:, None] * points[:, :2], np.where(np.isfinite(scale)[:, None, None], J, np.nan)

    def distort_by_coefficients(self, points: Array) -> Array:
        """See :class:`Lens`; n = 4."""
        x, y, z = points.T
        r = np.hypot(x, y)
        angle = np.arctan2(r, z)
        away = points[:, :2] / np.where(r > 0, r, 1.0)[:, None]
        return np.asarray(away[..., None] * angle[:, None, None] ** np.array([3, 5, 7, 9]))

    def undistort(self, distorted: Array) -> Array:
        """See :class:`Lens`."""
        radius = np.hypot(distorted[:, 0], distorted[:, 1])
        angles = np.linspace(0, self.limit, _TABLE_SIZE)
        angle = np.interp(radius, self._profile(angles)[0], angles)
        for _ in range(_MAX_ITERATIONS):
            value, slope = self._profile(angle)
            step = (value - radius) / np.maximum(slope, 1e-12)
            angle = np.clip(angle - step, 0, self.limit)
            if not np.any(np.abs(step) > _CONVERGENCE_STEP):
                break
        sine_over_radius = np.where(radius > 0, np.sin(angle) / np.where(radius > 0, radius, 1.0), 1.0)
        return np.concatenate([sine_over_radius[:, None] * distorted, np.cos(angle)[:, None]], axis=-1)

    def _profile(self, angle: Array) -> tuple[Array, Array]:
        """Distorted radii at angles from the axis (rad), and their derivatives."""
        k1, k2, k3, k4 = self.k
        s = angle * angle
        value = angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        return value, 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))


def pinhole_lens(distortion: Array) -> Pinhole:
    """Builds the pinhole lens with 0, 4, 5 or 8 coefficients in OpenCV's order."""
    k = np.pad(distortion, (0, 8 - len(distortion)))
    num, den = np.array([1, k[0], k[1], k[4]]), np.array([1, *k[5:8]])
    # The slope of r * num(s) / den(s) with s = r², times den²: num den + 2 s (num' den - num den'); and the pole.
    # Bundles build a lens at every state: np.polynomial.Polynomial would take four times as long.
    powers, slope = np.arange(1, 4), np.convolve(num, den)
    slope[1:] += 2 * (np.convolve(powers * num[1:], den) - np.convolve(num, powers * den[1:]))
    limit = np.sqrt(min(_first_root(slope), _first_root(den)))
    return Pinhole(k, min(float(limit), float(np.tan(_MAX_PINHOLE_ANGLE))))


def fisheye_lens(distortion: Array) -> Fisheye:
    """Builds the fisheye lens with 0 or 4 coefficients."""
    k = np.pad(distortion, (0, 4 - len(distortion)))
    slope = np.array([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])
    return Fisheye(k, min(float(np.sqrt(_first_root(slope))), _MAX_FISHEYE_ANGLE))


def _first_root(coefficients: Array) -> float:
    """The smallest positive real root of a polynomial, or infinity; coefficients ascend, and the first is 1."""
    # Coefficients this small have no effect within any field of view, but their roots overflow.
    degree = np.flatnonzero(np.abs(coefficients) > 1e-30)[-1]
    roots = np.polynomial.polynomial.polyroots(coefficients[: degree + 1])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))].real
    positive = real[real > 0]
    return float(positive.min()) if len(positive) else np.inf


def _interpolate_radial_inverse(distorted: Array, radii: Array, distorted_radii: Array) -> Array:
    """Undistorted coordinates (N, 2) by interpolation in samples of the radial profile alone."""
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    factor = np.interp(radius, distorted_radii, radii) / np.where(radius > 0, radius, 1.0)
    return distorted * factor[:, None]


def _clip_radius(undistorted: Array, limit: float) -> Array:
    """Coordinates (N, 2) scaled to the radius ``limit`` where they exceed it."""
    radius = np.hypot(undistorted[:, 0], undistorted[:, 1])
    return undistorted * np.where(radius > limit, limit / np.where(radius > 0, radius, 1.0), 1.0)[:, None]


def _determinant(D: Array) -> Array:
    """Determinants (N,) of (N, 2, 2), without warnings for NaN."""
    return np.asarray(D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0])


def _normalize(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# Points in one cell of this width may occlude each other: about the angle between a LiDAR's beams, rad.
_OCCLUSION_CELL = 0.02
# Points whose depths differ by less than this belong to one surface: a fraction of the distance, plus metres.
_SURFACE_DEPTH_RATIO, _SURFACE_DEPTH = 0.05, 0.1
# So do points whose inverse distances differ by less, 1/m: inverse distance is linear in the direction on a plane,
# however slanted. On a floor 1.2 m below the camera it changes by this much across two cells.
_MAX_INVERSE_DEPTH_STEP = 0.035


def colorize_points(
    points: Array, camera: CameraModel, pixels: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Looks up the colours of points in an image.

    A point is not visible if it is outside the image, or well behind another in nearly the same direction.

    Args:
        points: (N, 3) in the camera's frame, m.
        camera: intrinsics of the full image.
        pixels: (h, w) grey or (h, w, 3) image in any order of channels; may be a resized image.

    Returns:
        Colours (N, 3) in the image's order of channels, 0 where not visible; and the mask (N,) of visible points.
    """
    at = camera.project(points)
    visible = np.flatnonzero(camera.contains(at))
    visible = visible[_unoccluded(points[visible], at[visible] / (_OCCLUSION_CELL * camera.focal))]
    resized = (at[visible] + 0.5) * np.divide(pixels.shape[1::-1], (camera.width, camera.height))
    column, row = resized.astype(np.intp).T
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    colors[visible] = np.atleast_3d(pixels)[row, column]
    mask = np.zeros(len(points), dtype=np.bool_)
    mask[visible] = True
    return colors, mask


def _unoccluded(points: Array, cells: Array) -> NDArray[np.bool_]:
    """(N,) mask of points (N, 3) that no other point occludes, given their cells (N, 2) of the view.

    Points are compared with the nearest point of their cell and of its neighbours, so that cell borders have no
    effect.
    """
    distance = np.linalg.norm(points, axis=1)
    column, row = np.floor(cells).astype(np.intp).T if len(cells) else np.zeros((2, 0), dtype=np.intp)
    column, row = column - column.min(initial=0) + 1, row - row.min(initial=0) + 1
    nearest = np.full((row.max(initial=0) + 2, column.max(initial=0) + 2), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    around = np.min([nearest[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0, initial=np.inf)
    behind = distance > (1 + _SURFACE_DEPTH_RATIO) * around + _SURFACE_DEPTH
    return np.asarray(~behind | (1 / around - 1 / np.maximum(distance, _SURFACE_DEPTH) < _MAX_INVERSE_DEPTH_STEP))

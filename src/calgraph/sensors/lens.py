"""How lenses bend directions: OpenCV's pinhole and fisheye distortion, their derivatives and their inverses.

A lens maps a point in the camera's frame to *bent* coordinates, pixels before focal length and principal point.
Both models are a radial profile that grows with the angle from the axis up to a *limit*; past it the polynomial
turns around and means nothing. Source: OpenCV 4, "Camera Calibration and 3D Reconstruction", and Kannala and
Brandt, "A generic camera model and calibration method", PAMI 2006.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calgraph.geometry import Array

_WIDEST = np.deg2rad(89.9)
"""Pinhole coordinates are tan(angle): past this angle they overflow before they mean anything, rad."""
_FISHEYE_WIDEST = np.pi - 1e-6
_ITERATIONS = 25
"""Newton's method takes 3 to 5 steps, and more only near the limit, where the slope vanishes."""
_CONVERGED = 1e-14
_START_SAMPLES = 256
_TINY = 1e-300


class Lens(Protocol):
    """What a lens does, whatever its model."""

    def bend(self, points: Array) -> tuple[Array, Array]:
        """Bent coordinates (N, 2) of points (N, 3) and their derivatives (N, 2, 3); NaN past the limit."""

    def by_coefficients(self, points: Array) -> Array:
        """Derivatives (N, 2, n) of the bent coordinates of points (N, 3) by the model's n coefficients."""

    def straighten(self, bent: Array) -> Array:
        """Unit vectors (N, 3) of bent coordinates (N, 2); past the limit any value, which does not bend back."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Rational radial and tangential distortion."""

    k: Array
    """(8,) k1 k2 p1 p2 k3 k4 k5 k6."""
    limit: float
    """Largest undistorted radius x/z before the profile folds back."""

    def bend(self, points: Array) -> tuple[Array, Array]:
        """See :class:`Lens`."""
        z = points[:, 2]
        front = z > 0
        depth = np.where(front, z, 1.0)[:, None]
        flat = points[:, :2] / depth
        # Multiplied out, so that a point almost beside the camera does not overflow.
        inside = front & (np.hypot(points[:, 0], points[:, 1]) < self.limit * depth[:, 0])
        flat = np.where(inside[:, None], flat, np.nan)
        bent, D = self._distort(flat)
        J = np.concatenate([D, -D @ flat[:, :, None]], axis=-1) / depth[:, :, None]
        # Tangential terms shift the fold a little; a mirrored neighbourhood is past it.
        unfolded = _determinant(D) > 0
        return np.where(unfolded[:, None], bent, np.nan), np.where(unfolded[:, None, None], J, np.nan)

    def by_coefficients(self, points: Array) -> Array:
        """See :class:`Lens`; n = 8."""
        x, y = (points[:, :2] / points[:, 2:]).T
        s = x * x + y * y
        _, _, _, _, _, k4, k5, k6 = self.k
        c, below = self._radial(s)[0], 1 + s * (k4 + s * (k5 + s * k6))
        powers = np.stack([s, s**2, s**3], axis=-1) / below[:, None]
        above = powers[:, None] * np.stack([x, y], axis=-1)[..., None]
        tangential = np.stack(
            [np.stack([2 * x * y, s + 2 * x * x], axis=-1), np.stack([s + 2 * y * y, 2 * x * y], axis=-1)], axis=1
        )
        return np.concatenate([above[..., :2], tangential, above[..., 2:], -c[:, None, None] * above], axis=-1)

    def straighten(self, bent: Array) -> Array:
        """See :class:`Lens`."""
        widest = min(np.arctan(self.limit), _WIDEST)
        radii = np.tan(np.linspace(0, widest, _START_SAMPLES))
        flat = _start(bent, radii, radii * self._radial(radii**2)[0])
        for _ in range(_ITERATIONS):
            value, D = self._distort(flat)
            determinant = _determinant(D)
            determinant = np.where(np.abs(determinant) > 1e-12, determinant, 1e-12)
            (ex, ey) = (value - bent).T
            step = np.stack([D[:, 1, 1] * ex - D[:, 0, 1] * ey, D[:, 0, 0] * ey - D[:, 1, 0] * ex], axis=-1)
            flat, before = _clip(flat - step / determinant[:, None], radii[-1]), flat
            if not np.any(np.abs(flat - before) > _CONVERGED * (1 + np.abs(flat))):
                break
        return _unit(np.concatenate([flat, np.ones((len(flat), 1))], axis=-1))

    def _radial(self, s: Array) -> tuple[Array, Array]:
        """The radial factor at squared radii ``s``, and its derivative by ``s``."""
        k1, k2, _, _, k3, k4, k5, k6 = self.k
        above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
        above_slope, below_slope = k1 + s * (2 * k2 + s * 3 * k3), k4 + s * (2 * k5 + s * 3 * k6)
        return above / below, (above_slope - above / below * below_slope) / below

    def _distort(self, flat: Array) -> tuple[Array, Array]:
        """Distorted coordinates (N, 2) of undistorted ones (N, 2), and their derivatives (N, 2, 2)."""
        p1, p2 = self.k[2:4]
        x, y = flat.T
        s = x * x + y * y
        c, slope = self._radial(s)
        bent = np.stack(
            [c * x + 2 * p1 * x * y + p2 * (s + 2 * x * x), c * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y]
        )
        cross = 2 * (slope * x * y + p1 * x + p2 * y)
        xx = c + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = c + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
        return bent.T, np.stack([np.stack([xx, cross], axis=-1), np.stack([cross, yy], axis=-1)], axis=-2)


@dataclass(frozen=True, eq=False)
class Fisheye:
    """Distance from the principal point as an odd polynomial of the angle from the axis."""

    k: Array
    """(4,) k1 k2 k3 k4."""
    limit: float
    """Largest angle from the axis before the profile folds back, rad."""

    def bend(self, points: Array) -> tuple[Array, Array]:
        """See :class:`Lens`."""
        x, y, z = points.T
        r2 = x * x + y * y
        r = np.sqrt(r2)
        angle = np.arctan2(r, z)
        angle = np.where(angle < self.limit, angle, np.nan)
        value, slope = self._profile(angle)
        rho2 = np.maximum(r2 + z * z, _TINY)
        # On the axis the profile over the radius tends to 1/z, and what divides by r2 is multiplied by zero.
        on_axis = r2 < _TINY
        scale = np.where(on_axis, 1 / np.where(on_axis & (z > 0), z, 1.0), value / np.where(on_axis, 1.0, r))
        bulge = np.where(on_axis, 0.0, (slope * z / rho2 - scale) / np.where(on_axis, 1.0, r2))
        scale = np.where(np.isfinite(angle) & (rho2 > _TINY), scale, np.nan)
        along = -slope / rho2
        J = np.stack(
            [
                np.stack([scale + bulge * x * x, bulge * x * y, along * x], axis=-1),
                np.stack([bulge * x * y, scale + bulge * y * y, along * y], axis=-1),
            ],
            axis=-2,
        )
        return scale[:, None] * points[:, :2], np.where(np.isfinite(scale)[:, None, None], J, np.nan)

    def by_coefficients(self, points: Array) -> Array:
        """See :class:`Lens`; n = 4."""
        x, y, z = points.T
        r = np.hypot(x, y)
        angle = np.arctan2(r, z)
        away = points[:, :2] / np.where(r > 0, r, 1.0)[:, None]
        return np.asarray(away[..., None] * angle[:, None, None] ** np.array([3, 5, 7, 9]))

    def straighten(self, bent: Array) -> Array:
        """See :class:`Lens`."""
        radius = np.hypot(bent[:, 0], bent[:, 1])
        angles = np.linspace(0, self.limit, _START_SAMPLES)
        angle = np.interp(radius, self._profile(angles)[0], angles)
        for _ in range(_ITERATIONS):
            value, slope = self._profile(angle)
            step = (value - radius) / np.maximum(slope, 1e-12)
            angle = np.clip(angle - step, 0, self.limit)
            if not np.any(np.abs(step) > _CONVERGED):
                break
        sine_over_radius = np.where(radius > 0, np.sin(angle) / np.where(radius > 0, radius, 1.0), 1.0)
        return np.concatenate([sine_over_radius[:, None] * bent, np.cos(angle)[:, None]], axis=-1)

    def _profile(self, angle: Array) -> tuple[Array, Array]:
        """Bent radii at angles from the axis (rad), and their derivatives."""
        k1, k2, k3, k4 = self.k
        s = angle * angle
        value = angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        return value, 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))


def pinhole(distortion: Array) -> Pinhole:
    """The pinhole lens with 0, 4, 5 or 8 coefficients in OpenCV's order."""
    k = np.pad(distortion, (0, 8 - len(distortion)))
    above, below = np.polynomial.Polynomial([1, k[0], k[1], k[4]]), np.polynomial.Polynomial([1, *k[5:8]])
    s = np.polynomial.Polynomial([0, 1])
    # The slope of r * above(r²) / below(r²), times below²; and the pole.
    slope = above * below + 2 * s * (above.deriv() * below - above * below.deriv())
    limit = np.sqrt(min(_first_root(slope), _first_root(below)))
    return Pinhole(k, min(float(limit), float(np.tan(_WIDEST))))


def fisheye(distortion: Array) -> Fisheye:
    """The fisheye lens with 0 or 4 coefficients."""
    k = np.pad(distortion, (0, 4 - len(distortion)))
    slope = np.polynomial.Polynomial([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])
    return Fisheye(k, min(float(np.sqrt(_first_root(slope))), _FISHEYE_WIDEST))


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """The smallest positive real root, or infinity."""
    # Terms this small act beyond any angle of view, but their roots overflow.
    roots = polynomial.trim(1e-30).roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))].real
    positive = real[real > 0]
    return float(positive.min()) if len(positive) else np.inf


def _start(bent: Array, radii: Array, bent_radii: Array) -> Array:
    """Undistorted coordinates (N, 2) by the radial profile alone, read from samples of it."""
    radius = np.hypot(bent[:, 0], bent[:, 1])
    factor = np.interp(radius, bent_radii, radii) / np.where(radius > 0, radius, 1.0)
    return bent * factor[:, None]


def _clip(flat: Array, limit: float) -> Array:
    """Coordinates (N, 2) pulled back to the circle of radius ``limit`` where they left it."""
    radius = np.hypot(flat[:, 0], flat[:, 1])
    return flat * np.where(radius > limit, limit / np.where(radius > 0, radius, 1.0), 1.0)[:, None]


def _determinant(D: Array) -> Array:
    """Determinants (N,) of (N, 2, 2), quiet about NaN."""
    return np.asarray(D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

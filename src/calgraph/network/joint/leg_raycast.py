"""Ranges along beams to the outlines of legs, with their derivatives.

The outline is an ellipse with small harmonics: in coordinates about the centre that the symmetric matrix

    S = I - [[A, B], [B, -A]] / r₀,   A + iB = (a + ib) exp(2iψ)

scales, with the heading ``ψ``, its distance from the centre is ``r + Σ c_k cos k(φ - ψ)`` in the direction ``φ``,
to first order in ``c_k``. To first order, ``a`` and ``b`` are the amplitudes of the cosine and the sine of twice
the direction: depth less width, and the rotation of the foot.

In scaled coordinates, with the vector ``q`` from the scanner to the centre, the unit vectors ``u`` along the beam
and ``n`` to its left, ``e = q·n`` and ``cos ι = sqrt(1 - e²/r²)``, the range is ``q·u - r cos ι - Σ(...) / cos
ι``.

The slope of the range is infinite at the edge of the outline. From a given ratio of ``|e|`` to ``r`` on, it is
continued linearly: beams near the edge determine the radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array

# Scale r₀ of the amplitudes of the ellipse, m: it makes them comparable with those of harmonics.
_SCALE = 0.065


@dataclass(frozen=True, eq=False)
class LegHits:
    """Predicted ranges of N beams to legs."""

    ranges: Array
    """(N,) m."""
    slope: Array
    """(N,) derivative of the range by the beam's offset from the centre: the effect of lateral errors."""
    jacobian: Array
    """(N, 3 + B) of the ranges by position (2, m) and heading (rad) of the leg in the beams' frame, and by the
    B parameters of its shape, m."""


def raycast_legs(
    origin: Array,
    direction: Array,
    center: Array,
    heading: Array,
    shape: Array,
    harmonics: Sequence[int],
    max_edge_ratio: float,
) -> LegHits:
    """Predicts the range of each beam to its leg; all in one frame.

    Args:
        origin: (2,) of the beams, m.
        direction: (N, 2) unit vectors.
        center: (N, 2) of the leg, m.
        heading: (N,) rad.
        shape: (B,) radius r, amplitudes a and b of the ellipse, and the amplitude of each harmonic, m.
        harmonics: their orders.
        max_edge_ratio: offset over radius from which the outline is continued linearly.
    """
    radius, a, b = shape[:3]
    c, s = np.cos(2 * heading), np.sin(2 * heading)
    A, B = (a * c - b * s) / _SCALE, (a * s + b * c) / _SCALE
    q, d = (center - origin).T, direction.T
    scaled = _scale(A, B, d)
    length = np.hypot(*scaled)
    u = scaled / length
    n = np.stack([-u[1], u[0]])
    along, e = _dot(q_scaled := _scale(A, B, q), u), _dot(q_scaled, n)
    x = e / radius
    inside = np.clip(x, -max_edge_ratio, max_edge_ratio)
    cos = np.sqrt(1 - inside * inside)
    depth_slope = -inside / cos
    depth = cos + depth_slope * (x - inside)
    angle = np.arctan2(u[1], u[0]) + np.pi + np.arcsin(inside) - heading
    deviation, by_angle, by_harmonics = np.zeros_like(x), np.zeros_like(x), []
    for k, amplitude in zip(harmonics, shape[3:], strict=True):
        c_k = np.cos(k * angle)
        deviation += amplitude * c_k
        by_angle -= k * amplitude * np.sin(k * angle)
        by_harmonics.append(-c_k / cos)
    by_e = -depth_slope - np.where(x == inside, (by_angle + deviation * x / cos) / (cos**2 * radius), 0.0)
    ranges = along - radius * depth - deviation / cos
    by_q = u + n * by_e
    by_turn = e - along * by_e - by_angle / cos

    def by_matrix(q_change: Array, d_change: Array) -> Array:
        """Derivative by an entry of S, which changes the scaled centre and direction as given."""
        turn = _dot(n, d_change) / length
        return np.asarray((_dot(by_q, q_change) + turn * by_turn - ranges * _dot(u, d_change) / length) / length)

    by_A = by_matrix(np.stack([-q[0], q[1]]), np.stack([-d[0], d[1]]))
    by_B = by_matrix(-q[::-1], -d[::-1])
    by_center = _scale(A, B, by_q) / length
    jacobian = [
        *by_center,
        2 * (A * by_B - B * by_A) + by_angle / (cos * length),
        (-depth - x * by_e) / length,
        (c * by_A + s * by_B) / _SCALE,
        (c * by_B - s * by_A) / _SCALE,
        *(column / length for column in by_harmonics),
    ]
    return LegHits(ranges / length, by_e, np.stack(jacobian, axis=1))


def _scale(A: Array, B: Array, vectors: Array) -> Array:
    """Vectors (2, N) in scaled coordinates."""
    x, y = vectors
    return np.stack([x - A * x - B * y, y - B * x + A * y])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1])

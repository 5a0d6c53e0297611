"""Ranges along beams to ellipses, with their derivatives: the measurement model of a scanner and a body."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class RaycastHits:
    """Intersections of N beams with an ellipse each."""

    ranges: Array
    """(N,) m; NaN where a beam misses its ellipse."""
    cos_incidence: Array
    """(N,) cosines of the angles between beams and outline normals, 0..1; NaN likewise."""
    jacobian: Array
    """(N, 5) of the ranges by the ellipse's position (2, m) and heading (rad) in the beams' frame, and its radii
    (2, m); predicted measurements have more columns."""


def raycast_ellipses(origin: Array, direction: Array, centre: Array, heading: Array, radii: Array) -> RaycastHits:
    """Intersects each beam with its ellipse; all in one frame.

    Args:
        origin: (N, 2) of the beams, m; or (2,) of all of them.
        direction: (N, 2) unit vectors.
        centre: (N, 2) of the ellipses, m.
        heading: (N,) direction of their second radius, rad.
        radii: (N, 2) across and along the heading, m; or (2,) of all of them.
    """
    axis = np.stack([np.cos(heading), np.sin(heading)])
    return raycast_ellipses_by_axis(origin, direction, centre, axis, radii)


def raycast_ellipses_by_axis(
    origin: Array, direction: Array, centre: Array, axis: Array, radii: Array
) -> RaycastHits:
    """As :func:`raycast_ellipses`, with headings given as unit vectors (2, N).

    The hit ``h``, in the axes of the ellipse and divided by its radii, satisfies ``|h| = 1``: the implicit
    derivative of this equation is that of the range.
    """
    c, s = axis
    (x, y), (dx, dy), (radius_across, radius_along) = (origin - centre).T, direction.T, radii.T
    # Beam origins and directions across (u) and along (v) the heading, in units of the radii.
    u, du = (c * y - s * x) / radius_across, (c * dy - s * dx) / radius_across
    v, dv = (c * x + s * y) / radius_along, (c * dx + s * dy) / radius_along
    square, half = du * du + dv * dv, u * du + v * dv
    with np.errstate(invalid="ignore"):
        ranges = (-half - np.sqrt(half * half - square * (u * u + v * v - 1))) / square
    u, v = u + ranges * du, v + ranges * dv
    normal = np.stack([c * v / radius_along - s * u / radius_across, s * v / radius_along + c * u / radius_across])
    slope = normal[0] * dx + normal[1] * dy
    by_heading = (x + ranges * dx) * normal[1] - (y + ranges * dy) * normal[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = np.stack([*normal, by_heading, u * u / radius_across, v * v / radius_along]) / slope
        cos_incidence = -slope / np.sqrt(normal[0] ** 2 + normal[1] ** 2)
    return RaycastHits(ranges, cos_incidence, jacobian.T)


def rotate_by_small_angles(c: Array, s: Array, angle: Array) -> Array:
    """Rotates unit vectors with components ``c`` and ``s`` (N,) by small angles (N,), rad: (2, N).

    A body turns by less than 0.1 rad within a scan, where the Taylor series is exact to 2e-9. It is much faster
    than sines and cosines of every beam's angle.
    """
    square = angle * angle
    cos, sin = 1 - square / 2 + square * square / 24, angle * (1 - square / 6 + square * square / 120)
    return np.stack([c * cos - s * sin, s * cos + c * sin])

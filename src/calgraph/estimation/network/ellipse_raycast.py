"""Ranges along beams to an ellipse: what a scanner measures of a body."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# Beams flatter than this on the outline, a cosine, do not count.
_GRAZING = 0.35


@dataclass(frozen=True, eq=False)
class Outlines:
    """Where beams meet ellipses."""

    ranges: Array
    """(N,) m; NaN where a beam misses its ellipse."""
    incidence: Array
    """(N,) cosines of the angles between beams and outlines' normals, 0..1; NaN likewise."""
    jacobian: Array
    """(N, 5) of the ranges by the ellipse's place (2, m) and turn (rad) before the scanner, and its radii (m)."""

    @property
    def squarely(self) -> NDArray[np.bool_]:
        """(N,) whether beams meet their ellipses squarely enough to count."""
        return np.asarray(self.incidence > _GRAZING)


def cast(origin: Array, direction: Array, centre: Array, heading: Array, radii: Array) -> Outlines:
    """Casts a beam each to an ellipse each; all in one frame.

    Args:
        origin: (N, 2) of the beams, m; or (2,) of all of them.
        direction: (N, 2) unit vectors.
        centre: (N, 2) of the ellipses, m.
        heading: (N,) direction of their second radius, rad.
        radii: (N, 2) across and along the heading, m; or (2,) of all of them.
    """
    return cast_facing(origin, direction, centre, np.stack([np.cos(heading), np.sin(heading)]), radii)


def cast_facing(origin: Array, direction: Array, centre: Array, facing: Array, radii: Array) -> Outlines:
    """The same for headings given as unit vectors (2, N).

    Where ``h`` is the hit in the ellipse's own axes over its radii, ``|h| = 1`` holds: differentiated, it says how
    far along the beam the hit moves with the ellipse.
    """
    c, s = facing
    (x, y), (dx, dy), (across, ahead) = (origin - centre).T, direction.T, radii.T
    # Where beams begin, and where they go, across and along the heading, in radii.
    u, du = (c * y - s * x) / across, (c * dy - s * dx) / across
    v, dv = (c * x + s * y) / ahead, (c * dx + s * dy) / ahead
    square, half = du * du + dv * dv, u * du + v * dv
    with np.errstate(invalid="ignore"):
        ranges = (-half - np.sqrt(half * half - square * (u * u + v * v - 1))) / square
    u, v = u + ranges * du, v + ranges * dv
    normal = np.stack([c * v / ahead - s * u / across, s * v / ahead + c * u / across])
    slope = normal[0] * dx + normal[1] * dy
    turn = (x + ranges * dx) * normal[1] - (y + ranges * dy) * normal[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = np.stack([*normal, turn, u * u / across, v * v / ahead]) / slope
        incidence = -slope / np.sqrt(normal[0] ** 2 + normal[1] ** 2)
    return Outlines(ranges, incidence, jacobian.T)


def turned(c: Array, s: Array, turn: Array) -> Array:
    """Unit vectors (2, N) with cosines and sines (N,), turned by small angles (N,), rad.

    A body hardly turns within a scan: few terms of the series tell it, far quicker than cosines of every beam.
    """
    square = turn * turn
    cos, sin = 1 - square / 2 + square * square / 24, turn * (1 - square / 6 + square * square / 120)
    return np.stack([c * cos - s * sin, s * cos + c * sin])

"""Ranges along beams to an ellipse: what a scanner measures of a body."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class Outlines:
    """Where beams meet ellipses."""

    ranges: Array
    """(N,) m; NaN where a beam misses its ellipse."""
    incidence: Array
    """(N,) cosines of the angles between beams and outlines' normals, 0..1; NaN likewise."""
    jacobian: Array
    """(N, 5) of the ranges by the ellipse's place (2, m) and turn (rad) before the scanner, and its radii (m)."""


def cast(origin: Array, direction: Array, centre: Array, heading: Array, radii: Array) -> Outlines:
    """Casts a beam each to an ellipse each; all in one frame.

    Where ``h`` is the hit in the ellipse's own axes over its radii, ``|h| = 1`` holds: differentiated, it says how
    far along the beam the hit moves with the ellipse.

    Args:
        origin: (N, 2) of the beams, m.
        direction: (N, 2) unit vectors.
        centre: (N, 2) of the ellipses, m.
        heading: (N,) direction of their second radius, rad.
        radii: (N, 2) across and along the heading, m.
    """
    c, s = np.cos(heading), np.sin(heading)
    start = _into(c, s, origin - centre) / radii
    ahead = _into(c, s, direction) / radii
    square, half = np.sum(ahead**2, axis=-1), np.sum(start * ahead, axis=-1)
    discriminant = half**2 - square * (np.sum(start**2, axis=-1) - 1)
    with np.errstate(invalid="ignore"):
        ranges = (-half - np.sqrt(discriminant)) / square
    hit = start + ranges[:, None] * ahead
    across, along = (hit / radii).T
    normal = np.stack([c * along - s * across, s * along + c * across], axis=-1)
    slope = np.sum(normal * direction, axis=-1)
    arm = origin + ranges[:, None] * direction - centre
    turn = arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]
    moved = np.concatenate([normal, turn[:, None], hit**2 / radii], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = moved / slope[:, None]
        incidence = -slope / np.linalg.norm(normal, axis=-1)
    return Outlines(ranges, incidence, jacobian)


def _into(c: Array, s: Array, vectors: Array) -> Array:
    """(N, 2) across and along a heading, of which cosines and sines (N,) are given."""
    x, y = vectors.T
    return np.stack([c * y - s * x, c * x + s * y], axis=-1)

"""What moves in a hall: ellipsoids, tapered limbs and boxes in frames that move, and rays that hit them.

Rays are (3, N) arrays, as those of :mod:`calgraph.simulation.solids`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.simulation.drive_beams import Hits

_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Part:
    """A solid at several times, in the frame in which it has simple dimensions.

    A limb is the cone about z with radius 1 at z = 0 and ``taper`` at z = ``length``, closed by balls of these
    radii; without a length it is a ball. A box reaches from -1 to 1.
    """

    A: Array
    """(3, 3, G) its frame's coordinates are ``A @ (x - origin)``."""
    origin: Array
    """(3, G) m."""
    length: float = 0.0
    taper: float = 1.0
    box: bool = False
    reflectivity: float = 0.4


class Mover(NamedTuple):
    """Something that moves, or stands where something moves later, upright within a cylinder."""

    place: Callable[[Array], Array]
    """(3, G) middle of its lowest section at times (G,), s, m."""
    radius: float
    """Of the cylinder that holds it, m."""
    height: float
    """m."""
    parts: Callable[[Array], list[Part]]
    """Its solids at times (G,)."""


def place_ellipsoid(R: Array, centre: Array, radii: Array | tuple[float, float, float], grey: float) -> Part:
    """An ellipsoid with half axes (3,) in a frame with rotations (3, 3, G) and origins (3, G), m."""
    return Part(np.swapaxes(R, 0, 1) / np.reshape(radii, (3, 1, 1)), centre, reflectivity=grey)


def place_box(R: Array, centre: Array, half: Array | tuple[float, float, float], grey: float) -> Part:
    """A box with half edges (3,) in a frame with rotations (3, 3, G) and origins (3, G), m."""
    return Part(np.swapaxes(R, 0, 1) / np.reshape(half, (3, 1, 1)), centre, box=True, reflectivity=grey)


def place_limb(
    start: Array,
    end: Array,
    radius: float | tuple[float, float],
    end_radius: float,
    grey: float,
    ahead: Array | None = None,
) -> Part:
    """A limb from (3, G) to (3, G), m.

    Args:
        start: where its axis begins.
        end: where its axis ends.
        radius: at its start, m; that ahead and that to the left of sections that are ellipses.
        end_radius: at its end, that to the left, m.
        grey: its reflectivity.
        ahead: (3, G) the direction of the first of two radii.
    """
    depth, width = radius if isinstance(radius, tuple) else (radius, radius)
    axis = end - start
    length = np.maximum(np.sqrt(np.sum(axis**2, axis=0)), 1e-6)
    z = axis / length
    reference = np.array([[0.83], [0.41], [0.37]]) if ahead is None else ahead
    x = reference - np.sum(reference * z, axis=0) * z
    x = x / np.maximum(np.sqrt(np.sum(x**2, axis=0)), 1e-6)
    y = np.cross(z, x, axis=0)
    # Lengths of limbs change by some millimetres: joints are placed, not turned.
    mean = float(length.mean())
    unit = 0.5 * (depth + width)
    A = np.stack([x / depth, y / width, z * (mean / unit / length)])
    return Part(A, start, mean / unit, end_radius / width, reflectivity=grey)


def cast_mover(mover: Mover, times: Array, column: Index, origin: Array, directions: Array) -> Hits:
    """Hits of rays from one point.

    Args:
        mover: what may be hit.
        times: (G,) of columns of rays, s.
        column: (N,) of each ray.
        origin: (3,) m.
        directions: (3, N) unit vectors.
    """
    count = directions.shape[1]
    ranges, cosines, grey = np.full(count, np.inf), np.ones(count), np.full(count, 0.5)
    for part in mover.parts(times):
        o = np.einsum("ijg,jg->ig", part.A, origin[:, None] - part.origin)[:, column]
        A = part.A[:, :, column]
        d = np.stack(
            [A[k, 0] * directions[0] + A[k, 1] * directions[1] + A[k, 2] * directions[2] for k in (0, 1, 2)]
        )
        distance = _cast_box(o, d) if part.box else _cast_limb(o, d, part.length, part.taper)
        closer = np.flatnonzero(distance < ranges)
        if len(closer):
            t = distance[closer]
            normal = _normals(o[:, closer] + t * d[:, closer], part)
            # Normals are mapped by the transposed matrix, directions back to the world's by its inverse.
            scale = np.sqrt(np.sum(np.einsum("jin,jn->in", A[:, :, closer], normal) ** 2, axis=0))
            ranges[closer] = t
            cosines[closer] = np.abs(np.sum(normal * d[:, closer], axis=0)) / np.maximum(scale, _TINY)
            grey[closer] = part.reflectivity
    return Hits(ranges, cosines, grey)


def _cast_limb(o: Array, d: Array, length: float, taper: float) -> Array:
    hit = _cast_ball(o, d, 0.0, 1.0)
    if not length:
        return hit
    hit = np.minimum(hit, _cast_ball(o, d, length, taper))
    slope = (taper - 1) / length
    radius, growth = 1 + slope * o[2], slope * d[2]
    a = d[0] ** 2 + d[1] ** 2 - growth**2
    b = o[0] * d[0] + o[1] * d[1] - radius * growth
    c = o[0] ** 2 + o[1] ** 2 - radius**2
    square = b**2 - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(square)) / a
        z = o[2] + t * d[2]
        side = (square > 0) & (a > _TINY) & (z > 0) & (z < length) & (t > 0)
    return np.where(side & (t < hit), t, hit)


def _cast_ball(o: Array, d: Array, z: float, radius: float) -> Array:
    """Distances (N,) in units of directions, which are no unit vectors."""
    oz = o[2] - z
    a = d[0] ** 2 + d[1] ** 2 + d[2] ** 2
    b = o[0] * d[0] + o[1] * d[1] + oz * d[2]
    square = b**2 - a * (o[0] ** 2 + o[1] ** 2 + oz**2 - radius**2)
    t = (-b - np.sqrt(np.maximum(square, 0))) / a
    return np.where((square > 0) & (t > 0), t, np.inf)


def _cast_box(o: Array, d: Array) -> Array:
    inverse = 1 / np.where(np.abs(d) < _TINY, _TINY, d)
    middle, reach = -o * inverse, np.abs(inverse)
    enter, leave = (middle - reach).max(axis=0), (middle + reach).min(axis=0)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def _normals(points: Array, part: Part) -> Array:
    """(3, N) normals of any length at points on a part, in its frame."""
    if part.box:
        largest = np.argmax(np.abs(points), axis=0)
        return np.asarray((largest == np.arange(3)[:, None]) * np.sign(points))
    if not part.length:
        return points
    along = np.clip(points[2], 0, part.length)
    on_side = (points[2] > 0) & (points[2] < part.length)
    slope = (1 - part.taper) / part.length * (1 + (part.taper - 1) * along / part.length)
    return np.stack([points[0], points[1], np.where(on_side, slope, points[2] - along)])

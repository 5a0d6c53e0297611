"""Ray casting in the plane: walls are segments, bodies are ellipses or polygons that move from beam to beam."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.simulation.network_walks import SimulatedWalk


def cast_segments(origin: Array, angles: Array, segments: Array) -> Array:
    """Distances (N,) from an origin (2,) in directions (N,) to the nearest of segments (S, 2, 2), or infinite."""
    nearest = np.full(len(angles), np.inf)
    c, s = np.cos(angles), np.sin(angles)
    for a, b in segments - origin:
        along = b - a
        # origin + r (c, s) = a + u along, by Cramer's rule.
        determinant = c * along[1] - s * along[0]
        determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
        r = (a[0] * along[1] - a[1] * along[0]) / determinant
        u = (a[0] * s - a[1] * c) / determinant
        hit = (r > 0) & (u >= 0) & (u <= 1)
        nearest = np.where(hit, np.fmin(nearest, r), nearest)
    return nearest


def cast_ellipses(origin: Array, angles: Array, centers: Array, headings: Array, axes: Array) -> Array:
    """Distances (N,) along beams to one ellipse each, infinite where they miss it.

    Args:
        origin: (2,) outside of the ellipses, m.
        angles: (N,) of the beams, rad.
        centers: (N, 2) m.
        headings: (N,) direction of the second radius, rad.
        axes: (2,) radii across and along the heading, m.
    """
    # In the ellipse's frame, scaled so that it is the unit circle.
    c, s = np.cos(headings), np.sin(headings)
    x, y = (origin - centers).T
    across, along = (-s * x + c * y) / axes[0], (c * x + s * y) / axes[1]
    d_across, d_along = np.sin(angles - headings) / axes[0], np.cos(angles - headings) / axes[1]
    square = d_across**2 + d_along**2
    half = across * d_across + along * d_along
    discriminant = half**2 - square * (across**2 + along**2 - 1)
    with np.errstate(invalid="ignore"):
        r = (-half - np.sqrt(discriminant)) / square
    return np.where((discriminant >= 0) & (r > 0), r, np.inf)


def cast_polygons(origin: Array, angles: Array, centers: Array, headings: Array, outline: Array) -> Array:
    """Distances (N,) along beams to one convex polygon each, infinite where they miss it.

    Args:
        origin: (2,) outside of the polygons, m.
        angles: (N,) of the beams, rad.
        centers: (N, 2) m.
        headings: (N,) direction of the polygon's x, rad.
        outline: (L, 2) its corners, counter-clockwise, m.
    """
    sides = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([sides[:, 1], -sides[:, 0]])
    c, s = np.cos(headings), np.sin(headings)
    x, y = (origin - centers).T
    place = np.column_stack([c * x + s * y, -s * x + c * y])
    direction = np.column_stack([np.cos(angles - headings), np.sin(angles - headings)])
    # The beam is inside of each side's half plane before or after it crosses the side (Cyrus and Beck 1978).
    room, rate = (normals * outline).sum(axis=1) - place @ normals.T, direction @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / rate
    enter = np.where(rate < 0, at, -np.inf).max(axis=1)
    leave = np.where(rate > 0, at, np.inf).min(axis=1)
    beside = ((rate == 0) & (room < 0)).any(axis=1)
    return np.where((enter > 0) & (enter <= leave) & ~beside, enter, np.inf)


def simulate_true_ranges(
    origin: Array, angles: Array, static: Array, times: Array, walks: Sequence[SimulatedWalk], max_range: float
) -> Array:
    """Ranges (C, M) of scans without noise, each beam at its time of measurement.

    Args:
        origin: (2,) the scanner's place, m.
        angles: (M,) directions of the beams in the world, rad.
        static: (M,) their distances to the static environment, m.
        times: (C, M) of measurement, s from the start of the recording.
        walks: the bodies.
        max_range: bodies farther away are left out, m.
    """
    ranges = np.broadcast_to(static, times.shape).copy()
    for walk in walks:
        scan, beam = _beams_near(origin, angles, times, walk, max_range)
        at = times[scan, beam]
        centers, headings = walk.pose_at(at)
        if walk.outline is None:
            hit = cast_ellipses(origin, angles[beam], centers, headings, walk.axes)
        else:
            hit = cast_polygons(origin, angles[beam], centers, headings, walk.outline)
        ranges[scan, beam] = np.minimum(ranges[scan, beam], hit)
    return ranges


def _beams_near(
    origin: Array, angles: Array, times: Array, walk: SimulatedWalk, max_range: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Scans and beams that can hit a body, from its position in the middle of each scan."""
    first, last = times[:, 0], times[:, -1]
    # A body that enters during a scan counts with its first position.
    centers, _ = walk.pose_at(np.clip((first + last) / 2, walk.start, None))
    x, y = (centers - origin).T
    distance = np.hypot(x, y)
    reach = walk.reach + walk.max_speed * (last - first) / 2
    near = np.flatnonzero((last >= walk.start) & (distance < max_range + reach))
    # The tangents to the circle that holds the body during the scan; all beams if the scanner is inside it.
    half = np.arcsin(np.minimum(reach[near] / np.maximum(distance[near], 1e-9), 1)) + 1e-6
    half[distance[near] <= reach[near]] = np.pi
    off = np.remainder(angles - np.arctan2(y[near], x[near])[:, None] + np.pi, 2 * np.pi) - np.pi
    scan, beam = np.nonzero(np.abs(off) <= half[:, None])
    return near[scan], beam

"""Ray casting in the plane: walls are segments, bodies are ellipses or polygons that move from beam to beam."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.simulation.network_floor import Floor
from calgraph.simulation.network_walks import SimulatedWalk

USUAL_MAX_SPEED = 4.0
"""Upper bound of the speed of bodies, m/s; faster ones have their measured one."""
_SEGMENT_BATCH = 32
"""Segments that are cast together, which then fit into the processor's cache."""
_SEARCH_RADIUS = 8.0
"""First radius within which walls are searched, m; it doubles for beams that hit none."""
_SAME_POINT = 1e-6
"""A beam leaves a mirror farther than this from the point where it hit it, m."""


@dataclass(frozen=True, eq=False)
class ScanPlane:
    """Beams of one scanner. Distances along them are horizontal ones."""

    origin: Array
    """(2,) the scanner's place, m."""
    angles: Array
    """(M,) directions of the beams in the world, rad."""
    slopes: Array
    """(M,) how far they rise per distance."""
    height: float
    """Of the scanner above the floor, m."""

    def cuts_at(self, height: float) -> bool:
        """Whether all beams stay at one height, m."""
        return self.height == height and not self.slopes.any()


@dataclass(frozen=True, eq=False)
class View:
    """What some beams of a scanner can hit, directly or by way of a mirror."""

    plane: ScanPlane
    """Of these beams; that of the scanner's image behind the mirror where they are reflected."""
    beams: NDArray[np.intp]
    """(M,) indices of the beams in a scan."""
    start: Array
    """(M,) distances of the mirror, m; 0 for direct beams."""
    end: Array
    """(M,) distances of the static environment, or of the next mirror, which hide what is behind, m."""
    background: Array
    """(M,) measured where there is no body, m; infinite for direct beams that hit a mirror."""


def cast_segments(origin: Array, angles: Array, segments: Array, start: Array | float = 0.0) -> Array:
    """Distances (N,) from an origin (2,) in directions (N,) to the nearest of segments (S, 2, 2), or infinite.

    Segments nearer than ``start`` (N,) do not count.
    """
    nearest = np.full(len(angles), np.inf)
    c, s, start = np.cos(angles)[:, None], np.sin(angles)[:, None], np.broadcast_to(start, len(angles))[:, None]
    for first in range(0, len(segments), _SEGMENT_BATCH):
        ends = segments[first : first + _SEGMENT_BATCH] - origin
        a, along = ends[:, 0].T, (ends[:, 1] - ends[:, 0]).T
        # origin + r (c, s) = a + u along, by Cramer's rule.
        determinant = c * along[1] - s * along[0]
        determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
        r = (a[0] * along[1] - a[1] * along[0]) / determinant
        u = (a[0] * s - a[1] * c) / determinant
        hit = (r > start) & (u >= 0) & (u <= 1)
        nearest = np.minimum(nearest, np.where(hit, r, np.inf).min(axis=1))
    return nearest


def cast_walls(origin: Array, angles: Array, floor: Floor, start: Array | float = 0.0) -> Array:
    """As :func:`cast_segments`, with the walls of a floor, of which those behind others are not looked at."""
    nearest = np.full(len(angles), np.inf)
    directions, start = np.column_stack([np.cos(angles), np.sin(angles)]), np.broadcast_to(start, len(angles))
    farthest = floor.reach_from(origin)
    beams, inner, outer = np.arange(len(angles)), 0.0, _SEARCH_RADIUS
    while len(beams) and inner < farthest:
        # What these beams hit between both radii touches the box of their parts between them.
        ends = np.concatenate([origin + radius * directions[beams] for radius in (inner, outer)])
        near = floor.segments[floor.segment_boxes.near(ends.min(axis=0), ends.max(axis=0))]
        nearest[beams] = np.minimum(nearest[beams], cast_segments(origin, angles[beams], near, start[beams]))
        beams, inner, outer = np.flatnonzero(nearest > outer), outer, 2 * outer
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


def cast_polygons(
    origin: Array, angles: Array, centers: Array, headings: Array, outline: Array, sizes: Array
) -> Array:
    """Distances (N,) along beams to one convex polygon each, infinite where they miss it.

    Args:
        origin: (2,) outside of the polygons, m.
        angles: (N,) of the beams, rad.
        centers: (N, 2) m.
        headings: (N,) direction of the polygon's x, rad.
        outline: (L, 2) its corners, counter-clockwise, m.
        sizes: (N,) factors of the outline.
    """
    sides = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([sides[:, 1], -sides[:, 0]])
    c, s = np.cos(headings), np.sin(headings)
    x, y = (origin - centers).T
    place = np.column_stack([c * x + s * y, -s * x + c * y])
    direction = np.column_stack([np.cos(angles - headings), np.sin(angles - headings)])
    # The beam is inside of each side's half plane before or after it crosses the side (Cyrus and Beck 1978).
    room = sizes[:, None] * (normals * outline).sum(axis=1) - place @ normals.T
    rate = direction @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / rate
    enter = np.where(rate < 0, at, -np.inf).max(axis=1)
    leave = np.where(rate > 0, at, np.inf).min(axis=1)
    beside = ((rate == 0) & (room < 0)).any(axis=1)
    return np.where((enter > 0) & (enter <= leave) & ~beside, enter, np.inf)


def build_views(plane: ScanPlane, floor: Floor, mirrors: Array, floor_distance: Array) -> tuple[View, ...]:
    """The direct view of a scanner, and one by way of each mirror that it has in view.

    Args:
        plane: the beams.
        floor: walls and obstacles.
        mirrors: (Q, 2, 2) end points of mirrors, m.
        floor_distance: (M,) where beams that fall reach the floor, m.
    """
    static = np.minimum(cast_walls(plane.origin, plane.angles, floor), floor_distance)
    distances = [cast_segments(plane.origin, plane.angles, mirror[None]) for mirror in mirrors]
    end = np.minimum.reduce([static, *distances])
    views = [View(plane, np.arange(len(end)), np.zeros_like(end), end, np.where(end < static, np.inf, static))]
    for mirror, distance in zip(mirrors, distances, strict=True):
        beams = np.flatnonzero((distance <= end) & (distance < static))
        if len(beams):
            image, start = _reflect(plane, beams, mirror), distance[beams] + _SAME_POINT
            beyond = cast_walls(image.origin, image.angles, floor, start)
            beyond = np.minimum(beyond, floor_distance[beams])
            views.append(View(image, beams, start, beyond, beyond))
    return tuple(views)


def simulate_true_ranges(
    views: Sequence[View], times: Array, walks: Sequence[SimulatedWalk], max_range: float
) -> Array:
    """Horizontal ranges (C, M) of scans without noise, each beam at its time of measurement, m.

    Args:
        views: of the scanner.
        times: (C, M) of measurement, s from the start of the recording.
        walks: the bodies.
        max_range: bodies farther away are left out, m.
    """
    ranges = np.full(times.shape, np.inf)
    for view in views:
        ranges[:, view.beams] = np.minimum(ranges[:, view.beams], view.background)
        for walk in walks:
            scan, beam = _beams_near(view.plane, times[:, view.beams], walk, max_range)
            column = view.beams[beam]
            hit = _cast_body(view.plane, beam, times[scan, column], walk)
            hit = np.where((hit > view.start[beam]) & (hit < view.end[beam]), hit, np.inf)
            ranges[scan, column] = np.minimum(ranges[scan, column], hit)
    return ranges


def _reflect(plane: ScanPlane, beams: NDArray[np.intp], mirror: Array) -> ScanPlane:
    """Some beams of a scanner as they come from its image behind a mirror (2, 2)."""
    along = (mirror[1] - mirror[0]) / np.linalg.norm(mirror[1] - mirror[0])
    off = plane.origin - mirror[0]
    origin = mirror[0] + 2 * (off @ along) * along - off
    angles = 2 * np.arctan2(along[1], along[0]) - plane.angles[beams]
    return replace(plane, origin=origin, angles=angles, slopes=plane.slopes[beams])


def _cast_body(plane: ScanPlane, beam: NDArray[np.intp], times: Array, walk: SimulatedWalk) -> Array:
    """Distances (N,) along some beams to a body at times (N,), infinite where they miss it."""
    centers, headings = walk.pose_at(times)
    if walk.outline is None:
        return cast_ellipses(plane.origin, plane.angles[beam], centers, headings, walk.axes)
    sizes = np.ones(len(beam))
    if walk.section is not None and not plane.cuts_at(walk.section.height):
        heights = plane.height + plane.slopes[beam] * np.linalg.norm(centers - plane.origin, axis=1)
        offsets, sizes = walk.section_at(times, heights)
        centers = centers + offsets
    return cast_polygons(plane.origin, plane.angles[beam], centers, headings, walk.outline, sizes)


def _beams_near(
    plane: ScanPlane, times: Array, walk: SimulatedWalk, max_range: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Scans and beams that can hit a body, from its position in the middle of each scan."""
    first, last = times[:, 0], times[:, -1]
    # A body that enters during a scan counts with its first position.
    centers, _ = walk.pose_at(np.clip((first + last) / 2, walk.start, None))
    x, y = (centers - plane.origin).T
    distance = np.hypot(x, y)
    level = walk.section is None or plane.cuts_at(walk.section.height)
    reach = (walk.reach if level else walk.full_reach) + max(walk.max_speed, USUAL_MAX_SPEED) * (last - first) / 2
    near = np.flatnonzero((last >= walk.start) & (distance < max_range + reach))
    # The tangents to the circle that holds the body during the scan; all beams if the scanner is inside it.
    half = np.arcsin(np.minimum(reach[near] / np.maximum(distance[near], 1e-9), 1)) + 1e-6
    half[distance[near] <= reach[near]] = np.pi
    off = np.remainder(plane.angles - np.arctan2(y[near], x[near])[:, None] + np.pi, 2 * np.pi) - np.pi
    scan, beam = np.nonzero(np.abs(off) <= half[:, None])
    return near[scan], beam

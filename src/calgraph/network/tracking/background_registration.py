"""Registers windows of scans of one scanner to a reference window: the pose of the scanner over time.

All windows are registered in one call. A point is matched to the reference's beam in its direction; its distance
from the line through the neighbours of that beam is minimized robustly, with a scale that decreases.

Source: Blais and Levine, "Registering multiview range data to create 3D computer objects", 1995, for matches by
projection; Censi, "An ICP variant using a point-to-line metric", ICRA 2008; Geman and McClure, 1987, for the loss.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, fit_local_lines
from calgraph.sensors import find_nearest_beams

# Beams on surfaces up to twice this many all take part: systematic errors limit the precision of more.
_SUFFICIENT_BEAMS = 150
# Windows that are registered in one call: bounds memory for recordings of hours.
_WINDOWS_PER_CALL = 256
# Prior standard deviation of a pose, m and rad: makes directions invertible that no surface determines.
_PRIOR_STDDEV = 1.0
# Steps at the last scale: the first ones of a window that agrees already.
_FINAL_STEPS = 3
# Agreement of windows that do not start again.
_SETTLED_AGREEMENT = 0.9
# Fewest beams that two scans share in the search for rotations.
_MIN_SHARED_BEAMS = 20


# Distance between neighbours on one surface, m, up to which they are connected, plus the next.
_MAX_NEIGHBOUR_DISTANCE = 0.1
# The same in beam spacings: neighbouring beams on a wall at a grazing angle of 10° end six spacings apart.
_MAX_NEIGHBOUR_SPACINGS = 6.0


@dataclass(frozen=True, eq=False)
class ReferenceScan:
    """Static surfaces around a scanner, by beam."""

    angles: Array
    """(B,) ascending, rad."""
    ranges: Array
    """(B,) m; infinite where nothing was measured."""

    @cached_property
    def points(self) -> Array:
        """(B, 2) m."""
        return to_points(self.angles, self.ranges)

    @cached_property
    def spacing(self) -> float:
        """Angle between neighbouring beams, rad."""
        return float(self.angles[-1] - self.angles[0]) / max(len(self.angles) - 1, 1)

    @cached_property
    def normals(self) -> Array:
        """(B, 2) of the lines through the neighbours of each point, NaN without one."""
        max_gap = _MAX_NEIGHBOUR_DISTANCE + _MAX_NEIGHBOUR_SPACINGS * self.spacing * self.ranges
        return fit_local_lines(self.points, max_gap)


@dataclass(frozen=True, eq=False)
class WindowPoses:
    """Poses of a scanner in windows of time."""

    poses: Array
    """(W, 3) x, y, m, and angle, rad, in the frame of the reference."""
    information: Array
    """(W, 3, 3) for points with a standard deviation of 1 m."""
    compared: NDArray[np.intp]
    """(W,) points in front of a surface of the reference, on it or behind it, that nothing hides."""
    agreeing: NDArray[np.intp]
    """(W,) those on it."""

    @property
    def agreement(self) -> Array:
        """(W,) share of the compared points that agree."""
        return np.asarray(self.agreeing / np.maximum(self.compared, 1))


@dataclass(frozen=True, eq=False)
class SurfaceMatches:
    """Points matched to surfaces of a reference."""

    distance: Array
    """(W, B) signed distance from the surface, m; NaN without one."""
    jacobian: Array
    """(W, B, 3) derivatives of the distance by the pose."""
    compared: NDArray[np.bool_]
    """(W, B) whether the point is compared."""


def to_points(angles: Array, ranges: Array) -> Array:
    """End points (..., B, 2) of beams, m; NaN without a range."""
    finite = np.where(np.isfinite(ranges), ranges, np.nan)
    return np.asarray(finite[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1))


def register_windows(reference: ReferenceScan, ranges: Array, noise: float) -> WindowPoses:
    """Registers windows to a reference.

    Windows that agree without any motion need a few steps only; those that do not agree after all steps start
    again from the best rotation.

    Args:
        reference: the reference.
        ranges: (W, B) m, of the same beams, of one window at least.
        noise: standard deviation of the ranges, m.
    """
    parts = range(0, len(ranges), _WINDOWS_PER_CALL)
    found = [_register_part(reference, ranges[k : k + _WINDOWS_PER_CALL], noise) for k in parts]
    return WindowPoses(*map(np.concatenate, zip(*(vars(one).values() for one in found), strict=True)))


# Maximum distance of a point from its match along the surface, m: farther along, a wall has other surfaces.
_MAX_TANGENTIAL = 0.5


def match_surfaces(reference: ReferenceScan, points: Array, poses: Array, max_distance: float) -> SurfaceMatches:
    """Matches points (W, B, 2) of windows at poses (W, 3) to the surfaces of a reference, up to a distance, m."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    rx, ry = c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]
    x, y = rx + poses[:, :1], ry + poses[:, 1:2]
    middle = (reference.angles[0] + reference.angles[-1]) / 2
    direction = middle + np.remainder(np.arctan2(y, x) - middle + np.pi, 2 * np.pi) - np.pi
    beam = find_nearest_beams(reference.angles, direction)
    nx, ny = reference.normals[beam, 0], reference.normals[beam, 1]
    dx, dy = x - reference.points[beam, 0], y - reference.points[beam, 1]
    distance = nx * dx + ny * dy
    # Comparisons with NaN are False.
    within = np.abs(direction - reference.angles[beam]) <= reference.spacing
    beside = np.abs(ny * dx - nx * dy) > _MAX_TANGENTIAL
    distance[~within] = np.nan
    # A nearer surface may occlude it; no surface is beyond it if the scanner did not move.
    hidden = distance > max_distance
    jacobian = np.stack([nx, ny, ny * rx - nx * ry], axis=-1)
    distance[(np.abs(distance) < max_distance) & beside] = np.nan
    return SurfaceMatches(distance, jacobian, np.isfinite(distance) & ~hidden)


# Points within this many standard deviations lie on the reference's surface; scale of the last step.
AGREEMENT_SIGMAS = 3.0
# Distance of points from the reference's surfaces at which the loss has half of its weight in the first step, m:
# a scanner turned by 3° moves points at 5 m by 0.26 m.
INITIAL_SCALE = 0.3


def _register_part(reference: ReferenceScan, ranges: Array, noise: float) -> WindowPoses:
    stride = max(1, int(np.isfinite(reference.normals[:, 0]).sum()) // _SUFFICIENT_BEAMS)
    chosen = np.arange(0, len(reference.angles), stride)
    chosen = chosen[np.isfinite(ranges[:, chosen]).any(axis=0)]
    points = to_points(reference.angles[chosen], ranges[:, chosen])
    at_rest = np.zeros((len(ranges), 3))
    found = _refine(reference, points, at_rest, noise, AGREEMENT_SIGMAS * noise)
    # First from rest, then by a search of rotations.
    for searched in (False, True):
        poor = np.flatnonzero(found.agreement < _SETTLED_AGREEMENT)
        if len(poor):
            initial = _search_rotations(reference, ranges[poor]) if searched else np.zeros((len(poor), 3))
            again = _refine(reference, points[poor], initial, noise, INITIAL_SCALE)
            better = again.agreeing > found.agreeing[poor]
            found = _replace(found, again, poor, better)
    return found


def _replace(found: WindowPoses, again: WindowPoses, windows: Index, better: NDArray[np.bool_]) -> WindowPoses:
    """The results with those of some windows (N,) replaced where others (N,) are better."""
    columns = [column.copy() for column in vars(found).values()]
    for column, other in zip(columns, vars(again).values(), strict=True):
        column[windows[better]] = other[better]
    return WindowPoses(*columns)


# Factor of this distance from one step to the next.
_SCALE_FACTOR = 0.5


def _refine(reference: ReferenceScan, points: Array, poses: Array, noise: float, scale: float) -> WindowPoses:
    """Poses by iteratively reweighted least squares, from poses (W, 3) and a scale, m."""
    final = AGREEMENT_SIGMAS * noise
    scales = [scale]
    while scales[-1] > final:
        scales.append(max(final, scales[-1] * _SCALE_FACTOR))
    prior = (noise / _PRIOR_STDDEV) ** 2 * np.eye(3)
    for scale in [*scales, *[final] * _FINAL_STEPS]:
        matches = match_surfaces(reference, points, poses, 3 * scale)
        near = np.abs(matches.distance) < 3 * scale
        e, J = np.where(near, matches.distance, 0), np.where(near[..., None], matches.jacobian, 0)
        Jt = np.swapaxes(J / (1 + (e[..., None] / scale) ** 2) ** 2, 1, 2)
        information = Jt @ J + prior
        poses = poses - np.linalg.solve(information, Jt @ e[..., None])[..., 0]
    matches = match_surfaces(reference, points, poses, 3 * final)
    agreeing = np.abs(matches.distance) < final
    return WindowPoses(poses, information, matches.compared.sum(axis=1), agreeing.sum(axis=1))


# Step of the search for large rotations, rad (1°).
_ROTATION_STEP = 0.0175
# Difference of ranges within which two beams agree in this search, m: a rotation by half a step changes the range
# of a wall at 4 m and 45° by 35 mm, a translation by as much as itself.
_ROTATION_TOLERANCE = 0.15


def _search_rotations(reference: ReferenceScan, ranges: Array) -> Array:
    """(W, 3) poses of windows (W, B): the rotation under which most ranges agree with the reference's."""
    step = max(1, round(_ROTATION_STEP / max(reference.spacing, 1e-6)))
    of_windows, of_reference = ranges[:, ::step], reference.ranges[::step]
    count = len(of_reference)
    best, poses = np.zeros(len(ranges)), np.zeros((len(ranges), 3))
    for shift in range(_MIN_SHARED_BEAMS - count, count - _MIN_SHARED_BEAMS + 1):
        window = of_windows[:, max(-shift, 0) : count - max(shift, 0)]
        shifted = of_reference[max(shift, 0) : count - max(-shift, 0)]
        both = np.isfinite(window) & np.isfinite(shifted)
        difference = np.where(both, window, np.inf) - np.where(np.isfinite(shifted), shifted, 0)
        agreeing = (np.abs(difference) < _ROTATION_TOLERANCE).sum(axis=1)
        # The share of agreeing beams and their number have equal weight.
        score = agreeing / np.sqrt(np.maximum(both.sum(axis=1), 1))
        better = score > best
        best[better], poses[better, 2] = score[better], shift * step * reference.spacing
    return poses

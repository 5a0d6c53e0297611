"""Point-to-line ICP of two static backgrounds, restricted to observable directions.

Two walls at an angle determine a pose; the walls of a corridor do not determine the translation along it. The
information of the background is added to that of the tracks in the observable directions only.

Source: Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.errors import Rejected
from calgraph.geometry import Array, fit_local_lines, se2
from calgraph.network.pairs.track_registration import rigid_motion_covariance
from calgraph.network.pairs.visibility_map import is_free_space

# Limit on steps; the match distance takes 6 to 8 of them to shrink.
_MAX_STEPS = 25
# Largest component of a step, m or rad, at which a match distance has converged.
_STEP_TOLERANCE = 1e-4
# Least extent of matched walls, m, by which errors of theirs are divided: keeps the quotient finite.
_MIN_EXTENT = 0.1


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Pose from static backgrounds, and the directions in which they determine it."""

    T_a_b: Array
    """(3, 3); in unobservable directions that of the initial pose."""
    information: Array
    """(3, 3) of the error in the fixed axes of a; zero in unobservable directions."""
    by_beam_errors: Array
    """(3, 10) derivative of the pose by the range bias (m), range scale, angle scale and stretches c and d of a
    and of b; zero in unobservable directions. Ranges are ``(1 + range scale + c cos 2φ + d sin 2φ)`` times true
    ones plus the range bias, true angles ``(1 + angle scale) φ + c sin 2φ - d cos 2φ`` for the stated ``φ``."""

    def fuse(self, T_a_b: Array, information: Array) -> tuple[Array, Array]:
        """Fuses this with an independent estimate and its information: pose (3, 3) and information (3, 3)."""
        total = self.information + information
        step = np.linalg.solve(total, self.information @ se2.difference(self.T_a_b, T_a_b))
        return se2.retract(T_a_b, np.asarray(step, dtype=np.float64)), total


@dataclass(frozen=True, eq=False)
class _SurfacePoints:
    """Points with the normals of lines through their neighbours."""

    points: Array
    normals: Array
    """Unit, towards the scanner."""

    @cached_property
    def tree(self) -> cKDTree:
        """KD-tree of the points."""
        return cKDTree(self.points)


# Distance between neighbours on one wall, m, up to which they are connected.
_MAX_NEIGHBOUR_DISTANCE = 0.15
# The same as a fraction of their range: half a degree at 10 degrees of incidence.
_MAX_NEIGHBOUR_RATIO = 0.05


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """Static background of a scanner, shared by all its pairs."""

    points: Array
    """(N, 2) in order of angle, m, scanner frame; NaN rows are breaks."""

    @cached_property
    def oriented_points(self) -> _SurfacePoints:
        """The points whose neighbours in order of angle lie on a line, with normals."""
        max_gap = np.maximum(_MAX_NEIGHBOUR_DISTANCE, _MAX_NEIGHBOUR_RATIO * np.linalg.norm(self.points, axis=1))
        normals = fit_local_lines(self.points, max_gap)
        straight = np.isfinite(normals[:, 0])
        return _SurfacePoints(self.points[straight], normals[straight])


# Minimum number of matches: a wall of 1 m at 2 m and one degree.
_MIN_MATCHES = 25
# Match distance of the first step over the standard deviation of points under the initial pose, within the next
# two limits: 99.7 % of a normal distribution.
_INITIAL_DISTANCE_FACTOR = 3.0
# Factor of the match distance from one step to the next.
_DISTANCE_FACTOR = 0.7
# Minimum match distance of the first step, m: a smaller one misses walls that contradict the initial pose.
_MIN_INITIAL_DISTANCE = 0.5
# Maximum match distance of the first step, m: with a larger one the two walls of a corridor match.
_MAX_INITIAL_DISTANCE = 0.8
# Standard deviation of errors common to a wall, m: range bias, plaster, mounting height.
_WALL_ERROR = 0.01
# Number of points of one wall with a common error, by which weights are divided.
_CORRELATED_POINTS = 10.0
# Distance at which an angle is measured in metres, m: half of a usual room.
_LEVER_ARM = 3.0
# Standard deviation above which a direction is not observable from walls, m (for the angle: m at _LEVER_ARM):
# tracks determine most directions to some centimetres.
_MAX_STDDEV = 0.03
# Match distance of the last step, m: three standard deviations of noise and walls.
_FINAL_DISTANCE = 0.06
# Distance by which a point has to lie before the other scanner's background to contradict it, m.
_FREE_SPACE_MARGIN = 0.3
# Minimum share of matches among matching and contradicting points.
_MIN_MATCH_SHARE = 0.5
# Factor on the standard deviations of the initial pose in this test: in a few seconds scanners measure one side
# of people only, which covariances of tracks do not contain.
_PRIOR_STDDEV_FACTOR = 2.0
# Squared Mahalanobis distance above which background and tracks contradict each other: chi-squared, three degrees
# of freedom, 99.9 %.
_MAX_MAHALANOBIS2 = 16.3


def align_backgrounds(
    T_a_b: Array, covariance: Array, background_a: StaticBackground, background_b: StaticBackground, sigma: float
) -> IcpResult | Rejected:
    """Aligns b's static background to a's, from an initial pose.

    Args:
        T_a_b: (3, 3) initial pose.
        covariance: (3, 3) of its error in the fixed axes of a.
        background_a: of a.
        background_b: of b.
        sigma: standard deviation of a point's distance from the other scanner's line, m.

    Returns:
        The alignment; rejected if the overlap is too small, if no direction is observable, or if background and
        initial pose contradict each other.
    """
    a, b = background_a.oriented_points, background_b.oriented_points
    if min(len(a.points), len(b.points)) < _MIN_MATCHES:
        return Rejected("too little static background")
    lever = float(np.median(np.linalg.norm(b.points, axis=1)))
    guess_stddev = np.sqrt(np.max(np.linalg.eigvalsh(covariance[:2, :2])) + lever**2 * covariance[2, 2])
    match_distance = float(
        np.clip(_INITIAL_DISTANCE_FACTOR * guess_stddev, _MIN_INITIAL_DISTANCE, _MAX_INITIAL_DISTANCE)
    )
    noise2 = (sigma**2 + _WALL_ERROR**2) * _CORRELATED_POINTS
    scale = np.array([1, 1, 1 / _LEVER_ARM])
    scale2 = np.outer(scale, scale)
    T = T_a_b
    for _ in range(_MAX_STEPS):
        matches = _match_points(T, a, b, match_distance)
        if len(matches[0]) < _MIN_MATCHES:
            return Rejected(f"only {len(matches[0])} points of the static background overlap")
        H, g = _build_normal_equations(T, a, b, matches, noise2, match_distance)
        directions, values = _find_observable_directions(H * scale2)
        step = np.asarray(-scale * (directions @ ((directions.T @ (scale * g)) / values)), dtype=np.float64)
        T = se2.retract(T, step)
        converged = float(np.max(np.abs(step))) < _STEP_TOLERANCE
        if converged and match_distance <= _FINAL_DISTANCE:
            break
        match_distance = max(_FINAL_DISTANCE, match_distance * _DISTANCE_FACTOR)
    matches = _match_points(T, a, b, _FINAL_DISTANCE)
    b_in_a, a_in_b = se2.apply(T, b.points), se2.apply(se2.inverse(T), a.points)
    contradicting = int(is_free_space(background_a.points, b_in_a, _FREE_SPACE_MARGIN).sum())
    contradicting += int(is_free_space(background_b.points, a_in_b, _FREE_SPACE_MARGIN).sum())
    count = len(matches[0])
    if count < _MIN_MATCHES or count < _MIN_MATCH_SHARE * (count + contradicting):
        return Rejected(f"{contradicting} static points of one lie in the free space of the other")
    H, _ = _build_normal_equations(T, a, b, matches, noise2, _FINAL_DISTANCE)
    directions, values = _find_observable_directions(H * scale2)
    if not directions.shape[1]:
        return Rejected("the static background determines no direction")
    deviation = directions.T @ (se2.difference(T, T_a_b) / scale)
    prior_covariance = directions.T @ (covariance / scale2) @ directions
    wall_covariance = _wall_error_covariance(T, a, matches[1], _WALL_ERROR)
    wall_covariance = directions.T @ (wall_covariance / scale2) @ directions
    icp_covariance = np.diag(1 / values) + wall_covariance
    total = _PRIOR_STDDEV_FACTOR**2 * prior_covariance + icp_covariance
    if deviation @ np.linalg.solve(total, deviation) > _MAX_MAHALANOBIS2:
        return Rejected("static background and tracks contradict each other")
    information = directions @ np.linalg.solve(icp_covariance, directions.T) / scale2
    by_errors = _differentiate_by_beam_errors(T, a, b, matches, noise2, _FINAL_DISTANCE)
    by_errors = -scale[:, None] * (directions @ ((directions.T @ (scale[:, None] * by_errors)) / values[:, None]))
    return IcpResult(T, information, by_errors)


_Matches = tuple[NDArray[np.intp], NDArray[np.intp]]


# Angle between the normals of matched points, rad (25 degrees): the error of a line through seven noisy points
# and of the initial pose; less than half of the angle between two walls of a room.
_MAX_NORMAL_ANGLE = float(np.radians(25))


def _match_points(T: Array, a: _SurfacePoints, b: _SurfacePoints, match_distance: float) -> _Matches:
    """Indices of points of b and of the nearest points of a, with similar normals, within the match distance."""
    x = se2.apply(T, b.points)
    distance, nearest = a.tree.query(x, distance_upper_bound=match_distance + _MAX_NEIGHBOUR_DISTANCE)
    of_b = np.flatnonzero(np.isfinite(distance))
    of_a = nearest[of_b]
    normal = a.normals[of_a]
    matched = np.sum(normal * (b.normals[of_b] @ T[:2, :2].T), axis=1) > np.cos(_MAX_NORMAL_ANGLE)
    matched &= np.abs(np.sum(normal * (x[of_b] - a.points[of_a]), axis=1)) < match_distance
    return of_b[matched], of_a[matched]


def _build_normal_equations(
    T: Array, a: _SurfacePoints, b: _SurfacePoints, found: _Matches, noise2: float, match_distance: float
) -> tuple[Array, Array]:
    J, w, r = _linearize_matches(T, a, b, found, noise2, match_distance)
    return J.T @ (w[:, None] * J), J.T @ (w * r)


def _linearize_matches(
    T: Array, a: _SurfacePoints, b: _SurfacePoints, found: _Matches, noise2: float, match_distance: float
) -> tuple[Array, Array, Array]:
    """Jacobian (N, 3), weights (N,) and distances (N,), m, of matched points from lines."""
    of_b, of_a = found
    rotated = b.points[of_b] @ T[:2, :2].T
    normal = a.normals[of_a]
    r = np.sum(normal * (rotated + T[:2, 2] - a.points[of_a]), axis=1)
    J = np.column_stack([normal, normal[:, 1] * rotated[:, 0] - normal[:, 0] * rotated[:, 1]])
    return J, 1 / (noise2 * (1 + (2 * r / match_distance) ** 2)), r


def _differentiate_by_beam_errors(
    T: Array, a: _SurfacePoints, b: _SurfacePoints, found: _Matches, noise2: float, match_distance: float
) -> Array:
    """(3, 10) derivative of the gradient of :func:`_build_normal_equations` by the beam errors of a and b."""
    of_b, of_a = found
    J, w, _ = _linearize_matches(T, a, b, found, noise2, match_distance)
    in_b = a.normals[of_a] @ T[:2, :2]
    by_a, by_b = -_displace_points(a.points[of_a], a.normals[of_a]), _displace_points(b.points[of_b], in_b)
    return np.asarray(J.T @ (w[:, None] * np.column_stack([by_a, by_b])))


def _displace_points(points: Array, normals: Array) -> Array:
    """(N, 5) by how much points (N, 2) are to be corrected along normals for a unit of each beam error."""
    ranges, azimuth = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    radial = np.sum(normals * points, axis=1)
    across = normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]
    cos, sin = np.cos(2 * azimuth), np.sin(2 * azimuth)
    return np.column_stack(
        [-radial / ranges, -radial, azimuth * across, sin * across - cos * radial, -cos * across - sin * radial]
    )


def _find_observable_directions(H: Array) -> tuple[Array, Array]:
    """Observable directions (3, k) and their information (k,) of a matrix scaled to metres."""
    values, vectors = np.linalg.eigh(H)
    observable = values > _MAX_STDDEV**-2
    return vectors[:, observable], values[observable]


def _wall_error_covariance(T_a_b: Array, a: _SurfacePoints, of_a: NDArray[np.intp], wall_error: float) -> Array:
    """Covariance (3, 3) of the pose due to errors common to a wall; shorter walls have larger errors of angle."""
    x, normal = a.points[of_a], a.normals[of_a]
    center = x.mean(axis=0)
    offset = x - center
    extent = float(np.sqrt(np.mean((normal[:, 1] * offset[:, 0] - normal[:, 0] * offset[:, 1]) ** 2)))
    return rigid_motion_covariance(T_a_b, center, wall_error, wall_error / max(extent, _MIN_EXTENT))

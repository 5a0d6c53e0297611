"""Point-to-line ICP of two static backgrounds, which says only what walls can say.

Two walls at an angle fix a pose; a corridor leaves its own direction open. What the walls fix is information to be
added to that of the tracks, in the directions in which there is some.

Source: Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.pairwise.track_registration import rigid_motion_covariance
from calgraph.pairwise.visibility_map import is_free_space

# Neighbours on either side that make a line, how far apart two neighbours of one wall are at most (m, and as a
# share of their range), and how far (m) the points of a line may stray from it.
_NEIGHBOURS_PER_SIDE = 3
_MAX_NEIGHBOUR_DISTANCE = (0.15, 0.05)
_MAX_LINE_STDDEV = 0.03
# Matched lines' normals differ by less than this, rad; both turn to their scanner: a wall has two sides.
_MAX_NORMAL_ANGLE = np.radians(25)
# Distance within which lines are matched (m): at first, however certain or uncertain the guess (else walls that
# contradict it were overlooked), and at last; and the factor from one step to the next.
_INITIAL_MATCH_DISTANCE, _FINAL_MATCH_DISTANCE, _MATCH_DISTANCE_FACTOR = (0.5, 0.8), 0.06, 0.7
_MAX_STEPS = 25
# Points that must match, and their share of those that have to: a point that the other scanner looks through by
# more than this (m) contradicts.
_MIN_MATCHES = 25
_MIN_MATCH_SHARE = 0.5
_FREE_SPACE_MARGIN = 0.3
# Points of one wall err together: range bias, plaster, mounting height (m). A point weighs as one of so many.
_CORRELATED_POINTS = 10.0
_WALL_ERROR = 0.01
# A direction is determined if its standard deviation is below this (m; m at _LEVER for the angle).
_MAX_STDDEV = 0.03
_LEVER_ARM = 3.0
# χ² with three degrees of freedom, 99.9 %: walls and guess contradict each other beyond it. The guess may err by
# so many times what its covariance says: in a few seconds people show one side only.
_MAX_CHI2 = 16.3
_PRIOR_STDDEV_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class IcpResult:
    """The pose that walls give, and in which directions they give one."""

    T_a_b: Array
    """(3, 3); in open directions that of the first guess."""
    information: Array
    """(3, 3) of the error in the fixed axes of a; without any in open directions."""
    observable_directions: Array
    """(3, k) orthonormal directions (x, y, theta times the lever) that the walls determine."""
    match_count: int
    """How many of b's points lie on lines of a."""

    def fuse(self, T_a_b: Array, information: Array) -> tuple[Array, Array]:
        """This and an independent estimate with its information together: pose (3, 3) and information (3, 3)."""
        total = self.information + information
        step = np.linalg.solve(total, self.information @ se2.difference(self.T_a_b, T_a_b))
        return se2.retract(T_a_b, np.asarray(step, dtype=np.float64)), total


@dataclass(frozen=True, eq=False)
class _OrientedPoints:
    """Points with the lines through their neighbours."""

    points: Array
    normals: Array
    """Unit, towards the scanner."""

    @cached_property
    def tree(self) -> cKDTree:
        """The points, to be asked for the nearest."""
        return cKDTree(self.points)


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """The static surroundings of a scanner, as all its pairs need them."""

    points: Array
    """(N, 2) in order of angle, m, scanner frame; NaN rows are breaks."""

    @cached_property
    def oriented_points(self) -> _OrientedPoints:
        """Those points that lie on lines."""
        return _fit_lines(self.points)


def align_backgrounds(
    T_a_b: Array, covariance: Array, background_a: StaticBackground, background_b: StaticBackground, sigma: float
) -> IcpResult | Rejected:
    """Aligns b's static background to a's, from a first guess.

    Args:
        T_a_b: (3, 3) first guess.
        covariance: (3, 3) of its error in the fixed axes of a.
        background_a: of a.
        background_b: of b.
        sigma: standard deviation of a point's distance from the other scanner's line, m.

    Returns:
        The alignment; rejected if too little overlaps, if nothing is determined, or if walls and guess contradict
        each other.
    """
    a, b = background_a.oriented_points, background_b.oriented_points
    if min(len(a.points), len(b.points)) < _MIN_MATCHES:
        return Rejected("too little static background")
    lever = float(np.median(np.linalg.norm(b.points, axis=1)))
    guess_stddev = np.sqrt(np.max(np.linalg.eigvalsh(covariance[:2, :2])) + lever**2 * covariance[2, 2])
    match_distance = float(np.clip(3 * guess_stddev, *_INITIAL_MATCH_DISTANCE))
    noise2 = sigma**2 + _WALL_ERROR**2
    T = T_a_b
    for _ in range(_MAX_STEPS):
        matches = _match_points(T, a, b, match_distance)
        if len(matches[0]) < _MIN_MATCHES:
            return Rejected(f"only {len(matches[0])} points of the static background overlap")
        H, g = _build_normal_equations(T, a, b, matches, noise2, match_distance)
        directions, values = _find_observable_directions(H)
        step = np.asarray(-_SCALE * (directions @ ((directions.T @ (_SCALE * g)) / values)), dtype=np.float64)
        T = se2.retract(T, step)
        converged = float(np.max(np.abs(step))) < 1e-4
        if converged and match_distance <= _FINAL_MATCH_DISTANCE:
            break
        match_distance = max(_FINAL_MATCH_DISTANCE, match_distance * _MATCH_DISTANCE_FACTOR)
    matches = _match_points(T, a, b, _FINAL_MATCH_DISTANCE)
    contradicting = int(is_free_space(background_a.points, se2.apply(T, b.points), _FREE_SPACE_MARGIN).sum())
    contradicting += int(
        is_free_space(background_b.points, se2.apply(se2.inverse(T), a.points), _FREE_SPACE_MARGIN).sum()
    )
    if len(matches[0]) < _MIN_MATCHES or len(matches[0]) < _MIN_MATCH_SHARE * (len(matches[0]) + contradicting):
        return Rejected(f"{contradicting} static points of one lie in space that the other looks through")
    H, _ = _build_normal_equations(T, a, b, matches, noise2, _FINAL_MATCH_DISTANCE)
    directions, values = _find_observable_directions(H)
    if not directions.shape[1]:
        return Rejected("the static background determines no direction")
    deviation = directions.T @ (se2.difference(T, T_a_b) / _SCALE)
    prior_covariance = directions.T @ (covariance / np.outer(_SCALE, _SCALE)) @ directions
    wall_covariance = (
        directions.T @ (_wall_error_covariance(T, a, matches[1]) / np.outer(_SCALE, _SCALE)) @ directions
    )
    icp_covariance = np.diag(1 / values) + wall_covariance
    if (
        deviation @ np.linalg.solve(_PRIOR_STDDEV_FACTOR**2 * prior_covariance + icp_covariance, deviation)
        > _MAX_CHI2
    ):
        return Rejected("walls and tracks contradict each other")
    information = directions @ np.linalg.solve(icp_covariance, directions.T) / np.outer(_SCALE, _SCALE)
    return IcpResult(T, information, directions, len(matches[0]))


# Tangent vectors divided by it are in metres throughout.
_SCALE = np.array([1, 1, 1 / _LEVER_ARM])


def _fit_lines(background: Array) -> _OrientedPoints:
    """The points (N, 2) that have a straight line through their neighbours in order of angle."""
    n, width = len(background), 2 * _NEIGHBOURS_PER_SIDE + 1
    if n < width:
        return _OrientedPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    windows = np.lib.stride_tricks.sliding_window_view(background, width, axis=0)
    ranges = np.linalg.norm(windows[..., _NEIGHBOURS_PER_SIDE], axis=1)
    gaps = np.linalg.norm(np.diff(windows, axis=2), axis=1)
    # NaN compares as false: windows over a break drop out here.
    connected = (gaps < np.maximum(_MAX_NEIGHBOUR_DISTANCE[0], _MAX_NEIGHBOUR_DISTANCE[1] * ranges[:, None])).all(
        axis=1
    )
    windows = windows[connected]
    centered = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(centered @ np.swapaxes(centered, 1, 2) / width)
    straight = (values[:, 0] < _MAX_LINE_STDDEV**2) & (values[:, 1] > 9 * values[:, 0])
    points, normals = windows[straight, :, _NEIGHBOURS_PER_SIDE], vectors[straight, :, 0]
    normals = np.where(np.sum(normals * points, axis=1, keepdims=True) > 0, -normals, normals)
    return _OrientedPoints(points, normals)


_Matches = tuple[NDArray[np.intp], NDArray[np.intp]]


def _match_points(T: Array, a: _OrientedPoints, b: _OrientedPoints, match_distance: float) -> _Matches:
    """Indices of points of b and of the nearest points of a, whose lines run alike, within reach."""
    x = se2.apply(T, b.points)
    distance, nearest = a.tree.query(x, distance_upper_bound=match_distance + _MAX_NEIGHBOUR_DISTANCE[0])
    of_b = np.flatnonzero(np.isfinite(distance))
    of_a = nearest[of_b]
    normal = a.normals[of_a]
    matched = np.sum(normal * (b.normals[of_b] @ T[:2, :2].T), axis=1) > np.cos(_MAX_NORMAL_ANGLE)
    matched &= np.abs(np.sum(normal * (x[of_b] - a.points[of_a]), axis=1)) < match_distance
    return of_b[matched], of_a[matched]


def _build_normal_equations(
    T: Array, a: _OrientedPoints, b: _OrientedPoints, found: _Matches, noise2: float, match_distance: float
) -> tuple[Array, Array]:
    of_b, of_a = found
    rotated = b.points[of_b] @ T[:2, :2].T
    normal = a.normals[of_a]
    r = np.sum(normal * (rotated + T[:2, 2] - a.points[of_a]), axis=1)
    J = np.column_stack([normal, normal[:, 1] * rotated[:, 0] - normal[:, 0] * rotated[:, 1]])
    w = 1 / (noise2 * _CORRELATED_POINTS * (1 + (2 * r / match_distance) ** 2))
    return J.T @ (w[:, None] * J), J.T @ (w * r)


def _find_observable_directions(H: Array) -> tuple[Array, Array]:
    """Directions (3, k), scaled to metres, in which the walls fix the pose, and their information (k,)."""
    values, vectors = np.linalg.eigh(H * np.outer(_SCALE, _SCALE))
    observable = values > _MAX_STDDEV**-2
    return vectors[:, observable], values[observable]


def _wall_error_covariance(T_a_b: Array, a: _OrientedPoints, of_a: NDArray[np.intp]) -> Array:
    """(3, 3) covariance of the pose for what all points of a wall err alike, which turns short walls more."""
    x, normal = a.points[of_a], a.normals[of_a]
    center = x.mean(axis=0)
    off = x - center
    along = float(np.sqrt(np.mean((normal[:, 1] * off[:, 0] - normal[:, 0] * off[:, 1]) ** 2)))
    return rigid_motion_covariance(T_a_b, center, _WALL_ERROR, _WALL_ERROR / max(along, 0.1))

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
from calgraph.pairwise.track_registration import rigid_spread
from calgraph.pairwise.visibility_map import looks_past

# Neighbours on either side that make a line, how far apart two neighbours of one wall are at most (m, and as a
# share of their range), and how far (m) the points of a line may stray from it.
_SIDE = 3
_APART = (0.15, 0.05)
_STRAIGHT = 0.03
# Matched lines' normals differ by less than this, rad; both turn to their scanner: a wall has two sides.
_TURNED = np.radians(25)
# Distance within which lines are matched (m): at first, however certain or uncertain the guess (else walls that
# contradict it were overlooked), and at last; and the factor from one step to the next.
_REACH, _CLOSE, _SHRINK = (0.5, 0.8), 0.06, 0.7
_STEPS = 25
# Points that must match, and their share of those that have to: a point that the other scanner looks through by
# more than this (m) contradicts.
_ENOUGH = 25
_SHARE = 0.5
_THROUGH = 0.3
# Points of one wall err together: range bias, plaster, mounting height (m). A point weighs as one of so many.
_TOGETHER = 10.0
_WALL = 0.01
# A direction is determined if its standard deviation is below this (m; m at _LEVER for the angle).
_DETERMINED = 0.03
_LEVER = 3.0
# χ² with three degrees of freedom, 99.9 %: walls and guess contradict each other beyond it. The guess may err by
# so many times what its covariance says: in a few seconds people show one side only.
_CONTRADICTION = 16.3
_UNDERSTATED = 2.0


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose that walls give, and in which directions they give one."""

    T_a_b: Array
    """(3, 3); in open directions that of the first guess."""
    information: Array
    """(3, 3) of the error in the fixed axes of a; without any in open directions."""
    determined: Array
    """(3, k) orthonormal directions (x, y, theta times the lever) that the walls determine."""
    matches: int
    """How many of b's points lie on lines of a."""

    def fused(self, T_a_b: Array, information: Array) -> tuple[Array, Array]:
        """This and an independent estimate with its information together: pose (3, 3) and information (3, 3)."""
        total = self.information + information
        step = np.linalg.solve(total, self.information @ se2.difference(self.T_a_b, T_a_b))
        return se2.retract(T_a_b, np.asarray(step, dtype=np.float64)), total


@dataclass(frozen=True, eq=False)
class _Lines:
    """Points with the lines through their neighbours."""

    points: Array
    normals: Array
    """Unit, towards the scanner."""

    @cached_property
    def places(self) -> cKDTree:
        """The points, to be asked for the nearest."""
        return cKDTree(self.points)


@dataclass(frozen=True, eq=False)
class Background:
    """The static surroundings of a scanner, as all its pairs need them."""

    points: Array
    """(N, 2) in order of angle, m, scanner frame; NaN rows are breaks."""

    @cached_property
    def lines(self) -> _Lines:
        """Those points that lie on lines."""
        return _lines(self.points)


def align(
    T_a_b: Array, covariance: Array, background_a: Background, background_b: Background, sigma: float
) -> Alignment | Rejected:
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
    a, b = background_a.lines, background_b.lines
    if min(len(a.points), len(b.points)) < _ENOUGH:
        return Rejected("too little static background")
    lever = float(np.median(np.linalg.norm(b.points, axis=1)))
    stray = np.sqrt(np.max(np.linalg.eigvalsh(covariance[:2, :2])) + lever**2 * covariance[2, 2])
    reach = float(np.clip(3 * stray, *_REACH))
    noise2 = sigma**2 + _WALL**2
    T = T_a_b
    for _ in range(_STEPS):
        found = _match(T, a, b, reach)
        if len(found[0]) < _ENOUGH:
            return Rejected(f"only {len(found[0])} points of the static background overlap")
        H, g = _normal_equations(T, a, b, found, noise2, reach)
        directions, values = _determined(H)
        step = np.asarray(-_SCALE * (directions @ ((directions.T @ (_SCALE * g)) / values)), dtype=np.float64)
        T = se2.retract(T, step)
        settled = float(np.max(np.abs(step))) < 1e-4
        if settled and reach <= _CLOSE:
            break
        reach = max(_CLOSE, reach * _SHRINK)
    found = _match(T, a, b, _CLOSE)
    through = int(looks_past(background_a.points, se2.apply(T, b.points), _THROUGH).sum())
    through += int(looks_past(background_b.points, se2.apply(se2.inverse(T), a.points), _THROUGH).sum())
    if len(found[0]) < _ENOUGH or len(found[0]) < _SHARE * (len(found[0]) + through):
        return Rejected(f"{through} static points of one lie in space that the other looks through")
    H, _ = _normal_equations(T, a, b, found, noise2, _CLOSE)
    directions, values = _determined(H)
    if not directions.shape[1]:
        return Rejected("the static background determines no direction")
    apart = directions.T @ (se2.difference(T, T_a_b) / _SCALE)
    allowed = directions.T @ (covariance / np.outer(_SCALE, _SCALE)) @ directions
    common = directions.T @ (_common_error(T, a, found[1]) / np.outer(_SCALE, _SCALE)) @ directions
    own = np.diag(1 / values) + common
    if apart @ np.linalg.solve(_UNDERSTATED**2 * allowed + own, apart) > _CONTRADICTION:
        return Rejected("walls and tracks contradict each other")
    information = directions @ np.linalg.solve(own, directions.T) / np.outer(_SCALE, _SCALE)
    return Alignment(T, information, directions, len(found[0]))


# Tangent vectors divided by it are in metres throughout.
_SCALE = np.array([1, 1, 1 / _LEVER])


def _lines(background: Array) -> _Lines:
    """The points (N, 2) that have a straight line through their neighbours in order of angle."""
    n, width = len(background), 2 * _SIDE + 1
    if n < width:
        return _Lines(np.zeros((0, 2)), np.zeros((0, 2)))
    windows = np.lib.stride_tricks.sliding_window_view(background, width, axis=0)
    ranges = np.linalg.norm(windows[..., _SIDE], axis=1)
    gaps = np.linalg.norm(np.diff(windows, axis=2), axis=1)
    # NaN compares as false: windows over a break drop out here.
    together = (gaps < np.maximum(_APART[0], _APART[1] * ranges[:, None])).all(axis=1)
    windows = windows[together]
    centered = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(centered @ np.swapaxes(centered, 1, 2) / width)
    straight = (values[:, 0] < _STRAIGHT**2) & (values[:, 1] > 9 * values[:, 0])
    points, normals = windows[straight, :, _SIDE], vectors[straight, :, 0]
    normals = np.where(np.sum(normals * points, axis=1, keepdims=True) > 0, -normals, normals)
    return _Lines(points, normals)


_Matches = tuple[NDArray[np.intp], NDArray[np.intp]]


def _match(T: Array, a: _Lines, b: _Lines, reach: float) -> _Matches:
    """Indices of points of b and of the nearest points of a, whose lines run alike, within reach."""
    x = se2.apply(T, b.points)
    distance, nearest = a.places.query(x, distance_upper_bound=reach + _APART[0])
    of_b = np.flatnonzero(np.isfinite(distance))
    of_a = nearest[of_b]
    normal = a.normals[of_a]
    alike = np.sum(normal * (b.normals[of_b] @ T[:2, :2].T), axis=1) > np.cos(_TURNED)
    alike &= np.abs(np.sum(normal * (x[of_b] - a.points[of_a]), axis=1)) < reach
    return of_b[alike], of_a[alike]


def _normal_equations(
    T: Array, a: _Lines, b: _Lines, found: _Matches, noise2: float, reach: float
) -> tuple[Array, Array]:
    of_b, of_a = found
    turned = b.points[of_b] @ T[:2, :2].T
    normal = a.normals[of_a]
    r = np.sum(normal * (turned + T[:2, 2] - a.points[of_a]), axis=1)
    J = np.column_stack([normal, normal[:, 1] * turned[:, 0] - normal[:, 0] * turned[:, 1]])
    w = 1 / (noise2 * _TOGETHER * (1 + (2 * r / reach) ** 2))
    return J.T @ (w[:, None] * J), J.T @ (w * r)


def _determined(H: Array) -> tuple[Array, Array]:
    """Directions (3, k), scaled to metres, in which the walls fix the pose, and their information (k,)."""
    values, vectors = np.linalg.eigh(H * np.outer(_SCALE, _SCALE))
    fixed = values > _DETERMINED**-2
    return vectors[:, fixed], values[fixed]


def _common_error(T_a_b: Array, a: _Lines, of_a: NDArray[np.intp]) -> Array:
    """(3, 3) covariance of the pose for what all points of a wall err alike, which turns short walls more."""
    x, normal = a.points[of_a], a.normals[of_a]
    center = x.mean(axis=0)
    off = x - center
    along = float(np.sqrt(np.mean((normal[:, 1] * off[:, 0] - normal[:, 0] * off[:, 1]) ** 2)))
    return rigid_spread(T_a_b, center, _WALL, _WALL / max(along, 0.1))

"""Lines and planes fitted to ranges along beams, with their covariance.

The beams' directions are the regressors and the ranges the observations, because the noise is along the beams.
Total least squares on the points attributes noise along the beam to the surface normal, which rotates an inclined
board by more than its standard deviation once it has some hundred points.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.config.settings import ScannerDetectionSettings
from calgraph.geometry import Array, Index, estimate_spread, measure_lengths, plane
from calgraph.sensors import SAME_DIRECTION

WhitenedResiduals = Callable[[Array], tuple[Array, Array]]
"""Parameters to whitened residuals (N,) and the Jacobian (N, P) of the whitened predictions."""

# Most Gauss-Newton iterations of a round: two suffice from the start values of RANSAC.
_ITERATIONS = 6


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A line or plane in the sensor frame."""

    parameters: Array
    """(2,) angle of the normal (rad) and distance (m) of a line; (4,) normal and offset of a plane."""
    covariance: Array
    """(2, 2) of the line's parameters; (3, 3) of the plane in the chart of ``plane.retract``."""
    inliers: NDArray[np.bool_]
    """(N,) the inliers of the last round."""
    scale: float
    """Robust standard deviation of the whitened residuals: 1 if the stated noise is right."""


# Minimum cosine of the angle of incidence (87°): flatter beams graze the surface, and a millimetre of its offset
# changes their range by more than 20.
MIN_COSINE = 0.05


def fit_line(
    angles: Array, ranges: Array, sigma_range: Array, sigma_angle: Array, start: Array
) -> SurfaceFit | None:
    """The line ``x cos(a) + y sin(a) = p`` through the ends of beams, with rejection of outliers.

    Args:
        angles: (N,) of the beams, rad.
        ranges: (N,) m.
        sigma_range: (N,) m.
        sigma_angle: (N,) rad.
        start: (2,) a near the solution, p > 0.

    Returns:
        The fit, or None if fewer than three beams agree or the beams graze the line.
    """

    def whitened(line: Array) -> tuple[Array, Array]:
        return whiten_line(line, angles, ranges, sigma_range, sigma_angle)

    start = np.asarray(start, dtype=np.float64)
    fit = _fit_robustly(whitened, lambda line, step: line + step, start)
    # Without a beam that intersects the line, the iterations have diverged.
    return fit if fit is not None and np.any(np.cos(angles - fit.parameters[0]) > MIN_COSINE) else None


def whiten_line(
    line: Array, angles: Array, ranges: Array, sigma_range: Array, sigma_angle: Array
) -> tuple[Array, Array]:
    """Residuals (N,) of ranges to a line, and the Jacobian (N, 2) of the prediction, both over their noise."""
    cosine = np.maximum(np.cos(angles - line[0]), MIN_COSINE)
    tangent = np.sin(angles - line[0]) / cosine
    sigma = np.hypot(sigma_range, sigma_angle * ranges * tangent)
    J = np.stack([-line[1] * tangent / cosine, 1 / cosine], axis=-1)
    return (ranges - line[1] / cosine) / sigma, J / sigma[:, None]


def fit_plane(
    ranges: Array, directions: Array, sigma_range: float | Array, sigma_angle: float, start: Array
) -> SurfaceFit | None:
    """The plane through the ends of beams from the origin, with rejection of outliers.

    Args:
        ranges: (N,) m.
        directions: (N, 3) unit vectors of the beams.
        sigma_range: of each beam, (N,) or the same for all, m.
        sigma_angle: of each beam's direction, about each axis, rad.
        start: (4,) near the solution, oriented towards the origin.

    Returns:
        The fit, or None if fewer than four beams agree or the beams graze the plane.
    """

    def whitened(planes: Array) -> tuple[Array, Array]:
        n, d = planes[:3], planes[3]
        cosine = np.minimum(directions @ n, -MIN_COSINE)
        tangent = np.sqrt(np.maximum(1 / cosine**2 - 1, 0))
        sigma = np.hypot(sigma_range, sigma_angle * ranges * tangent)
        J = np.column_stack([d / cosine[:, None] ** 2 * (directions @ plane.tangent_basis(n)), -1 / cosine])
        return (ranges + d / cosine) / sigma, J / sigma[:, None]

    fit = _fit_robustly(whitened, plane.retract, start)
    return fit if fit is not None and np.any(directions @ fit.parameters[:3] < -MIN_COSINE) else None


# Rounds of rejection: the first one is by a fit with outliers, the second one by a fit to inliers.
_REJECTION_ROUNDS = 2
# Residual, in standard deviations, above which weights of the first round fall (Huber): 96 % efficient.
_HUBER_SIGMAS = 1.5
# Residuals beyond this many robust standard deviations are outliers: 0.3 % of the correct ones are.
OUTLIER_SIGMAS = 3.0
# The covariance is scaled by the reduced χ² where the stated noise makes that χ² less probable than this.
_INFLATION_SIGNIFICANCE = 0.001


def _fit_robustly(
    whitened: WhitenedResiduals, retract: Callable[[Array, Array], Array], parameters: Array
) -> SurfaceFit | None:
    """Gauss–Newton in rounds, each on the inliers of the round before."""
    inliers = np.ones(len(whitened(parameters)[0]), dtype=bool)
    scale = 1.0
    for round_ in range(_REJECTION_ROUNDS + 1):
        for _ in range(_ITERATIONS):
            residuals, J = whitened(parameters)
            # Before the first rejection Huber weights limit the influence of outliers.
            size = np.maximum(np.abs(residuals), 1e-12)
            weights = 1.0 * inliers if round_ else np.minimum(1.0, _HUBER_SIGMAS / size)
            H = (J * weights[:, None]).T @ J
            if inliers.sum() <= J.shape[1] or np.linalg.cond(H) > 1e14:
                return None
            step: Array = np.asarray(np.linalg.solve(H, J.T @ (weights * residuals)), dtype=np.float64)
            parameters = retract(parameters, step)
            if np.abs(step).max() < 1e-9:
                break
        residuals, J = whitened(parameters)
        scale = max(1.0, estimate_spread(residuals[inliers]))
        inliers = np.abs(residuals) < OUTLIER_SIGMAS * scale
    if inliers.sum() <= J.shape[1]:
        return None
    freedom, total = inliers.sum() - J.shape[1], float(residuals[inliers] @ residuals[inliers])
    # Scaled where the reduced chi-square is significantly above one, as the stated noise is then too small.
    inflation = total / freedom if total > chdtri(freedom, _INFLATION_SIGNIFICANCE) else 1.0
    covariance = np.linalg.inv(J[inliers].T @ J[inliers]) * inflation
    return SurfaceFit(parameters, np.asarray(covariance, dtype=np.float64), inliers, scale)


# Bound of ranges before the plane, m: beams that do not intersect it have an infinite one.
_FAR = 1e3


def select_beams_with_margin(near: NDArray[np.bool_]) -> Index:
    """Indices of the beams (N,) that pass near the board, and of two beams on either side of each."""
    return np.flatnonzero(np.convolve(near, np.ones(5), mode="same") > 0.5)


def find_board_edges(
    directions: Array,
    excess: Array,
    scan_line: Index,
    thickness: float,
    settings: ScannerDetectionSettings,
    parallax: float,
) -> Array:
    """Pairs of beams between which the board ends.

    Args:
        directions: (N, 3) unit vectors of beams that measured something, line by line, each in order of angle;
            equal for several returns of one beam.
        excess: (N,) range beyond the board's plane, m; negative where a beam ends before the plane, and where it
            does not intersect it.
        scan_line: (N,) scan line of each beam.
        thickness: a beam ends on the board up to this distance from its plane along the beam, m.
        settings: of the detection.
        parallax: error of the directions of beams that miss the board, as they do not start in the sensor's
            origin, rad. If it is not zero, directions do not show how many beams without return lie between two.

    Returns:
        (M, 2, 3) unit vectors: the last beam on the board, and the direction of the first one past it.
    """
    if not len(directions):
        return np.empty((0, 2, 3))
    directions, excess, scan_line = _join_returns(directions, np.maximum(excess, -_FAR), scan_line, thickness)
    on_board = np.abs(excess) < thickness
    adjacent = on_board[1:] & on_board[:-1] & (scan_line[1:] == scan_line[:-1])
    steps = measure_lengths(np.diff(directions, axis=0))[adjacent]
    if not len(steps):
        return np.empty((0, 2, 3))
    step = float(np.median(steps))
    orders = (slice(None), slice(None, None, -1))
    beams = [(directions[o], excess[o], on_board[o], scan_line[o]) for o in orders]
    return np.concatenate([_find_trailing_edges(*ordered, step, settings, parallax) for ordered in beams])


def _join_returns(
    directions: Array, excess: Array, scan_line: Index, thickness: float
) -> tuple[Array, Array, Index]:
    """One beam for each direction: neighbouring beams that differ measure the step, and are where an edge may be.

    A beam with returns from the board and from behind it ends between both, as a mixed pixel does. Of one that hit
    something nearer than the board, the nearest return counts: it may hide the edge.
    """
    starts = measure_lengths(np.diff(directions, axis=0)) > SAME_DIRECTION
    first = np.append(0, np.flatnonzero(starts | (np.diff(scan_line) != 0)) + 1)
    nearest = np.minimum.reduceat(excess, first)
    mean = np.add.reduceat(excess, first) / np.diff(np.append(first, len(excess)))
    return directions[first], np.where(nearest < -thickness, nearest, mean), scan_line[first]


# Maximum angle between beams on either side of an edge, in beam spacings: three beams may be missing.
_MAX_STEP_RATIO = 4.0
# Depth jump from a beam past the board to the next one, m, that makes it a mixed pixel of board and background:
# three times min_depth_jump, so that it ends clearly between both.
_MIN_MIXED_JUMP = 0.3


def _find_trailing_edges(
    directions: Array,
    excess: Array,
    on_board: NDArray[np.bool_],
    scan_line: Index,
    step: float,
    settings: ScannerDetectionSettings,
    parallax: float,
) -> Array:
    """Edges at which beams, in this order, leave the board."""
    # One beam off the board, on another scan line, ends the last one.
    directions, excess = np.pad(directions, ((0, 1), (0, 0)), mode="edge"), np.append(excess, 0.0)
    on_board, scan_line = np.append(on_board, False), np.append(scan_line, scan_line.max() + 1)
    if len(scan_line) < 4:
        return np.empty((0, 2, 3))
    previous, last, next_beam, after_next = (slice(i, len(scan_line) - 3 + i) for i in range(4))
    max_step = _MAX_STEP_RATIO * step
    gap = measure_lengths(directions[next_beam] - directions[last])
    last_step = directions[last] - directions[previous]
    step_length = measure_lengths(last_step)
    same_line = (scan_line[previous] == scan_line[last]) & (scan_line[last] == scan_line[next_beam])
    board_ends = same_line & on_board[previous] & on_board[last] & ~on_board[next_beam]
    board_ends &= step_length < max_step
    # Beams without return between others did not hit the board.
    near = gap < max_step + parallax
    no_return = ~near & (parallax == 0)
    behind = excess > settings.min_depth_jump
    # A beam between two depths is a mixed pixel: the edge may be on either side of it.
    mixed_pixel = near & (scan_line[after_next] == scan_line[next_beam]) & behind[after_next]
    mixed_pixel &= (excess[next_beam] > 0) & (excess[after_next] - excess[next_beam] > _MIN_MIXED_JUMP)
    is_edge = board_ends & (no_return | (near & behind[next_beam]) | mixed_pixel)
    steps = np.where(near, np.maximum(np.rint(gap / step), 1.0), 1.0) if parallax == 0 else np.ones(len(gap))
    angle_past = step * (steps + mixed_pixel)
    ratio = np.divide(angle_past, step_length, out=np.zeros_like(angle_past), where=step_length > 0)
    outside = directions[last] + last_step * ratio[:, None]
    pairs = np.stack([directions[last], outside / measure_lengths(outside)[:, None]], axis=1)
    return np.asarray(pairs[is_edge])

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

from calgraph.geometry import Array, find_median, plane

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
    angles: Array,
    ranges: Array,
    sigma_range: Array,
    sigma_angle: Array,
    start: Array,
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
        return whiten_line(line, angles, ranges, sigma_range, sigma_angle, MIN_COSINE)

    start = np.asarray(start, dtype=np.float64)
    return _fit_robustly(whitened, lambda line, step: line + step, start)


def whiten_line(
    line: Array, angles: Array, ranges: Array, sigma_range: Array, sigma_angle: Array, min_cosine: float
) -> tuple[Array, Array]:
    """Residuals (N,) of ranges to a line, and the Jacobian (N, 2) of the prediction, both over their noise."""
    cosine = np.maximum(np.cos(angles - line[0]), min_cosine)
    tangent = np.sin(angles - line[0]) / cosine
    sigma = np.hypot(sigma_range, sigma_angle * ranges * tangent)
    J = np.stack([-line[1] * tangent / cosine, 1 / cosine], axis=-1)
    return (ranges - line[1] / cosine) / sigma, J / sigma[:, None]


def fit_plane(
    ranges: Array,
    directions: Array,
    sigma_range: float | Array,
    sigma_angle: float,
    start: Array,
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

    return _fit_robustly(whitened, plane.retract, start)


# Rounds of rejection: the first one is by a fit with outliers, the second one by a fit to inliers.
_REJECTION_ROUNDS = 2
# Residual, in standard deviations, above which weights of the first round fall (Huber): 96 % efficient.
_HUBER_SIGMAS = 1.5
# Residuals beyond this many robust standard deviations are outliers: 0.3 % of the correct ones are.
OUTLIER_SIGMAS = 3.0
# The covariance is scaled by the reduced χ² where the stated noise makes that χ² less probable than this.
_INFLATION_SIGNIFICANCE = 0.001


def _fit_robustly(
    whitened: WhitenedResiduals,
    retract: Callable[[Array, Array], Array],
    parameters: Array,
) -> SurfaceFit | None:
    """Gauss–Newton in rounds, each on the inliers of the round before."""
    inliers = np.ones(len(whitened(parameters)[0]), dtype=bool)
    scale = 1.0
    for round_ in range(_REJECTION_ROUNDS + 1):
        for _ in range(_ITERATIONS):
            residuals, J = whitened(parameters)
            # Before the first rejection Huber weights limit the influence of outliers.
            weights = 1.0 * inliers if round_ else _compute_huber_weights(residuals, _HUBER_SIGMAS)
            H = (J * weights[:, None]).T @ J
            if inliers.sum() <= J.shape[1] or np.linalg.cond(H) > 1e14:
                return None
            step: Array = np.asarray(np.linalg.solve(H, J.T @ (weights * residuals)), dtype=np.float64)
            parameters = retract(parameters, step)
            if np.abs(step).max() < 1e-9:
                break
        residuals, J = whitened(parameters)
        scale = max(1.0, 1.4826 * find_median(np.abs(residuals[inliers])))
        inliers = np.abs(residuals) < OUTLIER_SIGMAS * scale
    if inliers.sum() <= J.shape[1]:
        return None
    inflation = _compute_inflation(residuals[inliers], J.shape[1], _INFLATION_SIGNIFICANCE)
    covariance = np.linalg.inv(J[inliers].T @ J[inliers]) * inflation
    return SurfaceFit(parameters, np.asarray(covariance, dtype=np.float64), inliers, scale)


def _compute_huber_weights(residuals: Array, threshold: float) -> Array:
    return np.minimum(1.0, threshold / np.maximum(np.abs(residuals), 1e-12))


def _compute_inflation(residuals: Array, parameters: int, significance: float) -> float:
    """The reduced chi-square where it is significantly above one, as the stated noise is then too small."""
    freedom = len(residuals) - parameters
    total = float(residuals @ residuals)
    return total / freedom if total > chdtri(freedom, significance) else 1.0

"""Centre of an object from its points in one scan: the centroid, and the fit of an ellipse of known radii."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People
from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.ellipse_fit import OrientationPrior, PointGroups, fit_ellipses

# Objects are fitted in batches of similar size, so that padding stays small.
_BATCH = 2048


@dataclass(frozen=True, eq=False)
class MeasuredCenters:
    """Measured centres of objects."""

    positions: Array
    """(C, 2) sensor frame, m; NaN where there is none."""
    noise: Array
    """(C, 2, 2) covariance of the error that is independent from scan to scan, m²."""
    bias: Array
    """(C, 2, 2) covariance of the error common to successive scans, which smoothing does not reduce, m²."""


@dataclass(frozen=True, eq=False)
class ObjectVelocities:
    """Velocities of the objects, estimated in a first pass over the recording."""

    values: Array
    """(C, 2) m/s."""
    variances: Array
    """(C,) of a velocity's component, m²/s²."""


def target_radii(target: People | Cylinder) -> tuple[float, float]:
    """Radii of the target's outline: across and along the direction of walk, m."""
    if isinstance(target, Cylinder):
        return target.diameter / 2, target.diameter / 2
    return target.axes


def target_width(target: People | Cylinder) -> float:
    """The largest width of the target, m."""
    return 2 * max(target_radii(target))


CenterEstimator = Callable[[Clusters, People | Cylinder, float], MeasuredCenters]
"""From objects, what they are, and the noise of a point (m) to their centres."""


# Distance of the centroid before the centre, over the mean radius: π/4 for a distant circle, less for the broad
# side of an ellipse.
DEPTH = 0.75
# Standard deviation of the centroid across the line of sight, over the mean radius: an oblique ellipse.
_LATERAL_SIGMA = 0.1


def measure_centroids(objects: Clusters, target: People | Cylinder, sigma: float) -> MeasuredCenters:
    """Centroids of the objects' points, whose offset from the centres is a bias.

    Args:
        objects: whose centres are measured.
        target: what they are.
        sigma: noise of a point, m.
    """
    radius = float(np.mean(target_radii(target)))
    bias = radial_covariances(
        objects.centroids,
        np.full(len(objects), (DEPTH * radius) ** 2),
        lateral_sigma(objects, radius) ** 2,
    )
    # The outermost beams on an object differ from scan to scan: variance of two uniform edges.
    edge = np.linalg.norm(objects.centroids, axis=-1) * objects.spacing / np.sqrt(24)
    noise = radial_covariances(
        objects.centroids,
        sigma**2 / objects.count + (_LATERAL_SIGMA * radius) ** 2,
        sigma**2 / objects.count + edge**2,
    )
    return MeasuredCenters(objects.centroids, noise, bias)


# Relative standard deviation of people's radii in the bias of a centre: clothes and posture change a person's
# radii by as much, and the centre along the line of sight by as much of them.
_PEOPLE_RADIUS_ERROR = 0.06
# Minimum speed with a known heading, m/s: the standard deviation of a velocity above.
_MIN_HEADING_SPEED = 0.2
# Standard deviation of people's shoulders about the normal of their walk: they turn by ± 9° with each step.
_SHOULDER_SIGMA = 0.15
# Standard deviation of a velocity from smoothed centroids, m/s: a centroid moves by 0.1 m on the body within half
# a second of a turn.
_VELOCITY_SIGMA = 0.2
# Standard deviation added to the centre of a partly hidden object, over its mean radius: which part is visible is
# unknown.
_CLIPPED_SIGMA = 0.15
# Lateral part of this bias over the radial one: both edges of the outline constrain the centre laterally.
_LATERAL_BIAS = 0.5


def measure_fixed_ellipses(
    objects: Clusters,
    target: People | Cylinder,
    velocities: ObjectVelocities,
    sigma: float,
) -> MeasuredCenters:
    """Centres of ellipses with the target's radii, fitted to the objects' points.

    Args:
        objects: whose centres are measured.
        target: what they are.
        velocities: of the objects; people's shoulders are across their walk.
        sigma: noise of a point, m.
    """
    radii = target_radii(target)
    radius_error = 0.0 if isinstance(target, Cylinder) else _PEOPLE_RADIUS_ERROR
    speed = np.linalg.norm(velocities.values, axis=-1)
    heading = np.arctan2(velocities.values[:, 1], velocities.values[:, 0])
    with np.errstate(divide="ignore"):
        heading_sigma = np.where(
            speed > _MIN_HEADING_SPEED,
            np.hypot(_SHOULDER_SIGMA, np.sqrt(velocities.variances + _VELOCITY_SIGMA**2) / speed),
            np.inf,
        )
    # The first radius of people is that of their shoulders, across the walk.
    prior = OrientationPrior(heading + np.pi / 2, heading_sigma)
    sigma = _estimate_point_sigma(objects, radii, prior, sigma)

    def fit_batch(groups: PointGroups, chosen: NDArray[np.intp]) -> Array:
        fits = fit_ellipses(groups, radii, OrientationPrior(prior.angle[chosen], prior.sigma[chosen]), sigma)
        return np.concatenate([fits.centers, fits.covariances.reshape(-1, 4)], axis=-1)

    result = map_batches(objects, 6, fit_batch)
    radius = float(np.mean(radii))
    occlusion_variance = np.where(objects.clipped, (_CLIPPED_SIGMA * radius) ** 2, 0.0)
    noise = result[:, 2:].reshape(-1, 2, 2) + occlusion_variance[:, None, None] * np.eye(2)
    # Wrong radii shift the centre along the line of sight; laterally the outline's edges constrain it.
    along = np.full(len(objects), (radius_error * radius) ** 2)
    return MeasuredCenters(
        result[:, :2], noise, radial_covariances(objects.centroids, along, _LATERAL_BIAS**2 * along)
    )


# Objects with the most beams whose residuals determine the noise of a point: that of the range and of the ellipse
# model, to 1 / sqrt(400) = 5 %.
_MISFIT_OBJECTS = 200
# Minimum number of beams on such an object: an ellipse with three unknowns leaves five degrees of freedom.
_MISFIT_MIN_BEAMS = 8


def _estimate_point_sigma(
    objects: Clusters, radii: tuple[float, float], prior: OrientationPrior, sigma: float
) -> float:
    """Standard deviation of a point on the target: range noise and misfit of the ellipse model, m.

    A single object of few beams does not determine it; those with the most beams do jointly.
    """
    best = np.argsort(objects.count, kind="stable")[-_MISFIT_OBJECTS:]
    best = best[objects.count[best] >= _MISFIT_MIN_BEAMS]
    if not len(best):
        return sigma
    fits = fit_ellipses(
        _pad_groups(objects, best), radii, OrientationPrior(prior.angle[best], prior.sigma[best]), sigma
    )
    return float(sigma * np.sqrt(max(1.0, np.median(fits.reduced_chi2))))


# The same for partly hidden objects: half of the object is missing.
_CLIPPED_LATERAL_SIGMA = 0.5


def lateral_sigma(objects: Clusters, radius: float) -> Array:
    """(C,) standard deviation of centroids across the line of sight, m."""
    ratio = np.where(objects.clipped, _CLIPPED_LATERAL_SIGMA, _LATERAL_SIGMA)
    return ratio * radius


def radial_covariances(points: Array, along: Array, across: Array) -> Array:
    """Covariances (C, 2, 2) with the given variances along and across the lines of sight to points (C, 2)."""
    sight = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    side = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
    return np.asarray(
        along[:, None, None] * sight[:, :, None] * sight[:, None, :]
        + across[:, None, None] * side[:, :, None] * side[:, None, :]
    )


def map_batches(
    objects: Clusters, columns: int, measure: Callable[[PointGroups, NDArray[np.intp]], Array]
) -> Array:
    """Calls ``measure`` with batches of the objects and their indices; its rows (., columns), in order."""
    result = np.full((len(objects), columns), np.nan)
    by_size = np.argsort(objects.count, kind="stable")
    for low in range(0, len(objects), _BATCH):
        chosen = by_size[low : low + _BATCH]
        result[chosen] = measure(_pad_groups(objects, chosen), chosen)
    return result


def _pad_groups(objects: Clusters, chosen: NDArray[np.intp]) -> PointGroups:
    column = np.arange(objects.count[chosen].max())
    used = column < objects.count[chosen, None]
    index = np.where(used, objects.first[chosen, None] + column, 0)
    points = np.where(used[..., None], objects.points[index], 0.0)
    return PointGroups(points, used, objects.spacing[chosen], objects.clipped[chosen])

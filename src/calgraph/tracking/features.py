"""Centre of an object from its points in one scan: three estimators, of rising effort and accuracy."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People
from calgraph.config.settings import CentroidSettings, EllipseSettings, TrackingSettings
from calgraph.geometry import Array, ellipse
from calgraph.tracking.clusters import Clusters
from calgraph.tracking.ellipse_fit import OrientationPrior, PointGroups, fit_ellipses

CenterFeature = Literal["com", "ellipse", "nls"]

# Radii of a free ellipse are plausible within these multiples of the target's.
_RADIUS_BOUNDS = (0.3, 2.0)
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


def measure_centers(
    feature: CenterFeature,
    objects: Clusters,
    target: People | Cylinder,
    velocities: ObjectVelocities,
    sigma: float,
    settings: TrackingSettings,
) -> MeasuredCenters:
    """Measures the centres of objects.

    Args:
        feature: ``com``, the centre of mass of the points; ``ellipse``, the centre of Fitzgibbon's ellipse, or the
            centre of mass moved back by the target's radius where that is not plausible; ``nls``, the centre of an
            ellipse with the target's radii.
        objects: whose centres are measured.
        target: what they are.
        velocities: of the objects; people's shoulders are across their walk.
        sigma: noise of a point, m.
        settings: of tracking.
    """
    if feature == "com":
        return _measure_centroids(objects, target_radii(target), sigma, settings.centroid)
    if feature == "ellipse":
        return _measure_direct_ellipses(objects, target_radii(target), sigma, settings.centroid)
    radius_error = 0.0 if isinstance(target, Cylinder) else settings.ellipse.people_radius_error
    return _measure_fixed_ellipses(
        objects, target_radii(target), velocities, sigma, radius_error, settings.ellipse
    )


def _measure_centroids(
    objects: Clusters, radii: tuple[float, float], sigma: float, settings: CentroidSettings
) -> MeasuredCenters:
    radius = float(np.mean(radii))
    bias = _radial_covariances(
        objects.centroids,
        np.full(len(objects), (settings.depth * radius) ** 2),
        _lateral_sigma(objects, radius, settings) ** 2,
    )
    # The outermost beams on an object differ from scan to scan: variance of two uniform edges.
    edge = np.linalg.norm(objects.centroids, axis=-1) * objects.spacing / np.sqrt(24)
    noise = _radial_covariances(
        objects.centroids,
        sigma**2 / objects.count + (settings.lateral_sigma * radius) ** 2,
        sigma**2 / objects.count + edge**2,
    )
    return MeasuredCenters(objects.centroids, noise, bias)


def _measure_direct_ellipses(
    objects: Clusters, radii: tuple[float, float], sigma: float, settings: CentroidSettings
) -> MeasuredCenters:
    shapes = _map_batches(objects, 5, lambda groups, _: ellipse.fit_direct(groups.points, groups.used))
    with np.errstate(invalid="ignore"):
        plausible = (shapes[:, 4] > _RADIUS_BOUNDS[0] * min(radii)) & (
            shapes[:, 3] < _RADIUS_BOUNDS[1] * max(radii)
        )
        plausible &= np.linalg.norm(shapes[:, :2] - objects.centroids, axis=-1) < _RADIUS_BOUNDS[1] * max(radii)
    centroids = _measure_centroids(objects, radii, sigma, settings)
    radius = float(np.mean(radii))
    sight = objects.centroids / np.maximum(np.linalg.norm(objects.centroids, axis=-1, keepdims=True), 1e-9)
    positions = np.where(plausible[:, None], shapes[:, :2], objects.centroids + settings.depth * radius * sight)
    # Free radii and the centre are correlated along the line of sight; residuals do not measure by how much.
    across = sigma**2 / objects.count + _lateral_sigma(objects, radius, settings) ** 2
    free = _radial_covariances(objects.centroids, np.full(len(objects), (0.5 * radius) ** 2), across)
    moved_back = _radial_covariances(
        objects.centroids,
        np.full(len(objects), (0.25 * radius) ** 2),
        _lateral_sigma(objects, radius, settings) ** 2,
    )
    noise = np.where(plausible[:, None, None], free, centroids.noise)
    return MeasuredCenters(positions, noise, np.where(plausible[:, None, None], 0.0, moved_back))


def _measure_fixed_ellipses(
    objects: Clusters,
    radii: tuple[float, float],
    velocities: ObjectVelocities,
    sigma: float,
    radius_error: float,
    settings: EllipseSettings,
) -> MeasuredCenters:
    speed = np.linalg.norm(velocities.values, axis=-1)
    heading = np.arctan2(velocities.values[:, 1], velocities.values[:, 0])
    with np.errstate(divide="ignore"):
        heading_sigma = np.where(
            speed > settings.min_heading_speed,
            np.hypot(settings.shoulder_sigma, np.sqrt(velocities.variances + settings.velocity_sigma**2) / speed),
            np.inf,
        )
    # The first radius of people is that of their shoulders, across the walk.
    prior = OrientationPrior(heading + np.pi / 2, heading_sigma)
    sigma = _estimate_point_sigma(objects, radii, prior, sigma, settings)

    def fit_batch(groups: PointGroups, chosen: NDArray[np.intp]) -> Array:
        fits = fit_ellipses(
            groups, radii, OrientationPrior(prior.angle[chosen], prior.sigma[chosen]), sigma, settings
        )
        return np.concatenate([fits.centers, fits.covariances.reshape(-1, 4)], axis=-1)

    result = _map_batches(objects, 6, fit_batch)
    radius = float(np.mean(radii))
    occlusion_variance = np.where(objects.clipped, (settings.clipped_sigma * radius) ** 2, 0.0)
    noise = result[:, 2:].reshape(-1, 2, 2) + occlusion_variance[:, None, None] * np.eye(2)
    # Wrong radii shift the centre along the line of sight; laterally the outline's edges constrain it.
    along = np.full(len(objects), (radius_error * radius) ** 2)
    return MeasuredCenters(
        result[:, :2], noise, _radial_covariances(objects.centroids, along, settings.lateral_bias**2 * along)
    )


def _estimate_point_sigma(
    objects: Clusters, radii: tuple[float, float], prior: OrientationPrior, sigma: float, settings: EllipseSettings
) -> float:
    """Standard deviation of a point on the target: range noise and misfit of the ellipse model, m.

    A single object of few beams does not determine it; those with the most beams do jointly.
    """
    best = np.argsort(objects.count, kind="stable")[-settings.misfit_objects :]
    best = best[objects.count[best] >= settings.misfit_min_beams]
    if not len(best):
        return sigma
    fits = fit_ellipses(
        _pad_groups(objects, best), radii, OrientationPrior(prior.angle[best], prior.sigma[best]), sigma, settings
    )
    return float(sigma * np.sqrt(max(1.0, np.median(fits.reduced_chi2))))


def _lateral_sigma(objects: Clusters, radius: float, settings: CentroidSettings) -> Array:
    ratio = np.where(objects.clipped, settings.clipped_lateral_sigma, settings.lateral_sigma)
    return ratio * radius


def _radial_covariances(points: Array, along: Array, across: Array) -> Array:
    """Covariances (C, 2, 2) with the given variances along and across the lines of sight to points (C, 2)."""
    sight = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    side = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
    return np.asarray(
        along[:, None, None] * sight[:, :, None] * sight[:, None, :]
        + across[:, None, None] * side[:, :, None] * side[:, None, :]
    )


def _map_batches(
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

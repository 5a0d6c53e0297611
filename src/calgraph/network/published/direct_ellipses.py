"""Centres of objects by direct ellipse fits, one of the features that the paper compares (lrf-network, III-B)."""

import numpy as np

from calgraph.config import Cylinder, People
from calgraph.config.settings import BaselineSettings, TrackingSettings
from calgraph.geometry import ellipse
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.features import (
    MeasuredCenters,
    lateral_sigma,
    map_batches,
    measure_centroids,
    radial_covariances,
    target_radii,
)


def measure_direct_ellipses(
    objects: Clusters,
    target: People | Cylinder,
    sigma: float,
    settings: TrackingSettings,
    limits: BaselineSettings = BaselineSettings(),
) -> MeasuredCenters:
    """Centres of Fitzgibbon's ellipses; where these are implausible, centroids moved back by the target's radius.

    Args:
        objects: whose centres are measured.
        target: what they are.
        sigma: noise of a point, m.
        settings: of tracking.
        limits: of plausible ellipses, and their standard deviations.
    """
    radii = target_radii(target)
    shapes = map_batches(objects, 5, lambda groups, _: ellipse.fit_direct(groups.points, groups.used))
    with np.errstate(invalid="ignore"):
        least, most = limits.min_ellipse_radius * min(radii), limits.max_ellipse_radius * max(radii)
        plausible = (shapes[:, 4] > least) & (shapes[:, 3] < most)
        plausible &= np.linalg.norm(shapes[:, :2] - objects.centroids, axis=-1) < most
    centroids = measure_centroids(objects, target, sigma, settings)
    radius = float(np.mean(radii))
    sight = objects.centroids / np.maximum(np.linalg.norm(objects.centroids, axis=-1, keepdims=True), 1e-9)
    positions = np.where(
        plausible[:, None], shapes[:, :2], objects.centroids + settings.centroid.depth * radius * sight
    )
    # Free radii and the centre are correlated along the line of sight; residuals do not measure by how much.
    across = sigma**2 / objects.count + lateral_sigma(objects, radius, settings.centroid) ** 2
    free = radial_covariances(
        objects.centroids, np.full(len(objects), (limits.direct_ellipse_stddev * radius) ** 2), across
    )
    moved_back = radial_covariances(
        objects.centroids,
        np.full(len(objects), (limits.replaced_ellipse_stddev * radius) ** 2),
        lateral_sigma(objects, radius, settings.centroid) ** 2,
    )
    noise = np.where(plausible[:, None, None], free, centroids.noise)
    return MeasuredCenters(positions, noise, np.where(plausible[:, None, None], 0.0, moved_back))

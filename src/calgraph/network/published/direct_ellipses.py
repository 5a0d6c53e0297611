"""Centres of objects by direct ellipse fits, one of the features that the paper compares (lrf-network, III-B)."""

import numpy as np

from calgraph.config import Cylinder, People
from calgraph.geometry import ellipse
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.features import (
    DEPTH,
    MeasuredCenters,
    lateral_sigma,
    map_batches,
    measure_centroids,
    radial_covariances,
    target_radii,
)

# Minimum radius of a plausible direct ellipse, over the target's smaller one: bodies vary by less, but short arcs
# give narrow ellipses.
_MIN_ELLIPSE_RADIUS = 0.3
# Maximum radius, and distance from the centroid, of a plausible direct ellipse, over the target's larger radius.
_MAX_ELLIPSE_RADIUS = 2.0
# Standard deviation of the centre of a direct ellipse along the beam, over the target's radius: its size is
# unknown, and residuals do not measure by how much the centre follows it.
_DIRECT_ELLIPSE_STDDEV = 0.5
# The same of the centroid that replaces an implausible ellipse: centroids of visible halves lie 0.6 to 0.8 of the
# radius before the centre.
_REPLACED_ELLIPSE_STDDEV = 0.25


def measure_direct_ellipses(objects: Clusters, target: People | Cylinder, sigma: float) -> MeasuredCenters:
    """Centres of Fitzgibbon's ellipses; where these are implausible, centroids moved back by the target's radius.

    Args:
        objects: whose centres are measured.
        target: what they are.
        sigma: noise of a point, m.
    """
    radii = target_radii(target)
    shapes = map_batches(objects, 5, lambda groups, _: ellipse.fit_direct(groups.points, groups.used))
    with np.errstate(invalid="ignore"):
        least, most = _MIN_ELLIPSE_RADIUS * min(radii), _MAX_ELLIPSE_RADIUS * max(radii)
        plausible = (shapes[:, 4] > least) & (shapes[:, 3] < most)
        plausible &= np.linalg.norm(shapes[:, :2] - objects.centroids, axis=-1) < most
    centroids = measure_centroids(objects, target, sigma)
    radius = float(np.mean(radii))
    sight = objects.centroids / np.maximum(np.linalg.norm(objects.centroids, axis=-1, keepdims=True), 1e-9)
    positions = np.where(plausible[:, None], shapes[:, :2], objects.centroids + DEPTH * radius * sight)
    # Free radii and the centre are correlated along the line of sight; residuals do not measure by how much.
    across = sigma**2 / objects.count + lateral_sigma(objects, radius) ** 2
    free = radial_covariances(
        objects.centroids, np.full(len(objects), (_DIRECT_ELLIPSE_STDDEV * radius) ** 2), across
    )
    moved_back = radial_covariances(
        objects.centroids,
        np.full(len(objects), (_REPLACED_ELLIPSE_STDDEV * radius) ** 2),
        lateral_sigma(objects, radius) ** 2,
    )
    noise = np.where(plausible[:, None, None], free, centroids.noise)
    return MeasuredCenters(positions, noise, np.where(plausible[:, None, None], 0.0, moved_back))

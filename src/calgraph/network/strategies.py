"""What options choose by name: the default, or a part of the paper, imported only where it is chosen."""

from functools import partial
from typing import TYPE_CHECKING

from calgraph.config.settings import BaselineSettings, CenterFeature

if TYPE_CHECKING:
    from calgraph.network.tracking.features import CenterEstimator


def select_center_estimator(feature: CenterFeature, settings: BaselineSettings) -> "CenterEstimator | None":
    """The estimator of the centres of tracked objects; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            from calgraph.network.tracking.features import measure_centroids

            return measure_centroids
        case "ellipse":
            from calgraph.network.published.direct_ellipses import measure_direct_ellipses

            return partial(measure_direct_ellipses, limits=settings)


def select_depth_stddev(feature: CenterFeature, settings: BaselineSettings) -> float | None:
    """Standard deviation of the distance from tracked to true centres, m; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            return settings.centroid_depth_stddev
        case "ellipse":
            return settings.direct_ellipse_depth_stddev

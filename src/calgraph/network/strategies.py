"""What options choose by name: the default, or a part of the paper, imported only where it is chosen."""

from typing import TYPE_CHECKING

from calgraph.config.settings import CenterFeature
from calgraph.network.pairs.scanner_pair import DEPTH_STDDEV

if TYPE_CHECKING:
    from calgraph.network.tracking.features import CenterEstimator


def select_center_estimator(feature: CenterFeature) -> "CenterEstimator | None":
    """The estimator of the centres of tracked objects; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            from calgraph.network.tracking.features import measure_centroids

            return measure_centroids
        case "ellipse":
            from calgraph.network.published.direct_ellipses import measure_direct_ellipses

            return measure_direct_ellipses


# m; prior standard deviation of the distance from centroids to true centres along the beam: that of a half circle
# lies 0.6 to 0.8 of the radius before the centre.
_CENTROID_DEPTH_STDDEV = 0.2
# m; the same for direct ellipse fits, whose size is unknown.
_DIRECT_ELLIPSE_DEPTH_STDDEV = 0.05


def select_depth_stddev(feature: CenterFeature) -> float:
    """Standard deviation of the distance from tracked to true centres, m."""
    match feature:
        case "nls":
            return DEPTH_STDDEV
        case "com":
            return _CENTROID_DEPTH_STDDEV
        case "ellipse":
            return _DIRECT_ELLIPSE_DEPTH_STDDEV

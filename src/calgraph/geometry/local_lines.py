"""Lines through neighbouring points of a scan."""

import numpy as np

from calgraph.geometry.arrays import Array

# Neighbours on either side of a point to which a line is fitted: seven points average noise, within 0.2 m at 4 m
# and half a degree.
_NEIGHBOURS_PER_SIDE = 3
_WIDTH = 2 * _NEIGHBOURS_PER_SIDE + 1
# Maximum standard deviation of neighbours from their line, m: three times the usual noise of a range.
_MAX_STDDEV = 0.03
# Minimum ratio of the neighbours' variances along and across the line: a standard deviation three times as long.
_MIN_ELONGATION2 = 9.0


def fit_local_lines(points: Array, max_gap: Array) -> Array:
    """Fits a line to each point of a scan and its neighbours.

    Args:
        points: (N, 2) in order of angle, m, sensor frame; rows that are not finite are breaks.
        max_gap: (N,) largest distance between successive points of the line of each point, m.

    Returns:
        (N, 2) unit normals of the lines, towards the scanner; NaN where the neighbours do not lie on a line.
    """
    normals = np.full(points.shape, np.nan)
    n = len(points)
    if n < _WIDTH:
        return normals
    middle = slice(_NEIGHBOURS_PER_SIDE, n - _NEIGHBOURS_PER_SIDE)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Comparisons with NaN are False, so windows over a break are dropped.
    widest = np.lib.stride_tricks.sliding_window_view(gaps, _WIDTH - 1).max(axis=1)
    kept = np.flatnonzero(widest < max_gap[middle])
    windows = np.lib.stride_tricks.sliding_window_view(points, _WIDTH, axis=0)[kept]
    centered = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(centered @ np.swapaxes(centered, 1, 2) / _WIDTH)
    good = (values[:, 0] < _MAX_STDDEV**2) & (values[:, 1] > _MIN_ELONGATION2 * values[:, 0])
    at, normal = kept[good] + _NEIGHBOURS_PER_SIDE, vectors[good, :, 0]
    normals[at] = np.where(np.sum(normal * points[at], axis=1, keepdims=True) > 0, -normal, normal)
    return normals

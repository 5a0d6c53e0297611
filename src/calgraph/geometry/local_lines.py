"""Lines through neighbouring points of a scan."""

import numpy as np

from calgraph.geometry.arrays import Array


def fit_local_lines(
    points: Array, neighbours_per_side: int, max_gap: Array, max_stddev: float, min_elongation2: float
) -> Array:
    """Fits a line to each point of a scan and its neighbours.

    Args:
        points: (N, 2) in order of angle, m, sensor frame; rows that are not finite are breaks.
        neighbours_per_side: number of neighbours on either side.
        max_gap: (N,) largest distance between successive points of the line of each point, m.
        max_stddev: largest standard deviation of the neighbours from their line, m.
        min_elongation2: least ratio of the neighbours' variances along and across the line.

    Returns:
        (N, 2) unit normals of the lines, towards the scanner; NaN where the neighbours do not lie on a line.
    """
    normals = np.full(points.shape, np.nan)
    n, width = len(points), 2 * neighbours_per_side + 1
    if n < width:
        return normals
    middle = slice(neighbours_per_side, n - neighbours_per_side)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Comparisons with NaN are False, so windows over a break are dropped.
    widest = np.lib.stride_tricks.sliding_window_view(gaps, width - 1).max(axis=1)
    kept = np.flatnonzero(widest < max_gap[middle])
    windows = np.lib.stride_tricks.sliding_window_view(points, width, axis=0)[kept]
    centered = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(centered @ np.swapaxes(centered, 1, 2) / width)
    good = (values[:, 0] < max_stddev**2) & (values[:, 1] > min_elongation2 * values[:, 0])
    at, normal = kept[good] + neighbours_per_side, vectors[good, :, 0]
    normals[at] = np.where(np.sum(normal * points[at], axis=1, keepdims=True) > 0, -normal, normal)
    return normals

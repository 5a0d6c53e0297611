"""Backgrounds of scanners, learned from a window without target and operator.

Source: MSG-Cal, section III-A (change detection between octrees). In the plane of a 2-D scanner, a threshold on
the range of each beam serves the same purpose with a finer resolution.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import DetectionSettings
from calgraph.errors import InputError
from calgraph.geometry import Array, measure_lengths
from calgraph.rig.detection.capture_background import (
    CloudBackground,
    find_direction_cells,
    find_local_maxima,
    find_voxels,
    pack_voxels,
)
from calgraph.sensors import LaserScan, PointCloud, ScanBackground, align_ranges

Indices = NDArray[np.intp]
Keys = NDArray[np.int64]
"""Of voxels."""

# Share of scans that may show dust, a passer-by, or the board, which comes as the window ends: one in twenty. It
# is the quantile of a beam's ranges that is its nearest depth, and space that so few sweeps measure is free.
_PASSING_SHARE = 0.05
# Ranges within this distance of the nearest depth, m, determine its noise: ten standard deviations of a noisy
# scanner (30 mm), and less than the jump at an edge of furniture.
_NOISE_WINDOW = 0.3
# Foreground ends at least this much before the background, m, where a beam shows little noise in the window: the
# board is half a metre from walls.
_MIN_MARGIN = 0.05
# The same in root mean squares of the ranges about the nearest depth: with a quantile of 5 %, foreground ends 1.6
# + 2.5 x 1.9 = 6.4 standard deviations before the mean.
_MARGIN_SIGMAS = 2.5


def learn_scan_background(scans: Sequence[LaserScan]) -> ScanBackground:
    """Learns the background of a 2-D scanner.

    A low quantile of each beam's ranges is its background depth. At an edge, where a beam alternates between two
    depths or averages them, both and all between them are then background. The margin grows with the standard
    deviation of the beam's ranges.

    Args:
        scans: of one sensor; not necessarily with the same beams.

    Raises:
        InputError: there are no scans, or no scan has a measurement.
    """
    if not any(scan.valid.any() for scan in scans):
        raise InputError("no returns in the background window; state a capture.background with measurements")
    angles = np.sort(max(scans, key=lambda scan: len(scan.angles)).angles)
    ranges = np.concatenate([align_ranges(angles, scan.angles, scan.ranges[None]) for scan in scans])
    # A low quantile of each beam's ranges, of which NaN are sorted last; NaN where a beam has no range.
    count = np.isfinite(ranges).sum(axis=0)
    row = np.floor(_PASSING_SHARE * np.maximum(count - 1, 0)).astype(np.intp)
    depths = np.sort(ranges, axis=0)[row, np.arange(ranges.shape[1])]
    # Only the scatter around the nearest depth: that of all ranges would be the size of the edge.
    offsets = np.where(np.abs(ranges - depths) < _NOISE_WINDOW, ranges - depths, np.nan)
    sigma = np.sqrt(np.nansum(offsets**2, axis=0) / np.maximum(np.isfinite(offsets).sum(axis=0), 1))
    margins = np.maximum(_MIN_MARGIN, _MARGIN_SIGMAS * sigma)
    return ScanBackground.from_depths(angles, depths, margins)


# Edge of a direction cell that holds the largest range of the background, 1°: several beams of any LiDAR.
_DIRECTION_CELL = math.radians(1.0)


def learn_cloud_background(clouds: Iterable[PointCloud], settings: DetectionSettings) -> CloudBackground:
    """Learns the background of a 3-D scanner.

    Every point occupies all voxels within half a voxel of it, in each axis, so that noise at the border of a voxel
    does not turn background into foreground. Voxels that only few sweeps occupy are free: something passed.

    Args:
        clouds: sweeps of one sensor; memory grows with the space they cover, not with their number.
        settings: of the model, and the least depth jump of the scanners.

    Raises:
        InputError: the clouds hold no points.
    """
    voxel, cell = settings.cloud_background.voxel, _DIRECTION_CELL
    keys, sweeps = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.intp)
    number = 0
    max_range = np.zeros((round(np.pi / cell), round(2 * np.pi / cell)))
    for cloud in clouds:
        occupied = _sort_distinct(_find_occupied(cloud.points, voxel))
        keys, sweeps = _add_occupied(keys, sweeps, occupied)
        number += 1
        cells = find_direction_cells(cloud.points, max_range.shape)
        np.maximum.at(max_range, cells, measure_lengths(cloud.points))
    if not len(keys):
        raise InputError("no points in the background window; state a capture.background with measurements")
    max_range = find_local_maxima(max_range)
    max_range = np.where(max_range > 0, max_range + settings.scanner.min_depth_jump, np.inf)
    return CloudBackground(voxel, keys[sweeps > _PASSING_SHARE * number], max_range)


def _add_occupied(keys: Keys, sweeps: Indices, occupied: Keys) -> tuple[Keys, Indices]:
    """Sorted keys of voxels and the sweeps that occupied each, with those of another sweep, sorted as well."""
    place = np.searchsorted(keys, occupied)
    known = place < len(keys)
    known[known] = keys[place[known]] == occupied[known]
    sweeps = sweeps.copy()
    sweeps[place[known]] += 1
    return np.insert(keys, place[~known], occupied[~known]), np.insert(sweeps, place[~known], 1)


def _find_occupied(points: Array, voxel: float) -> NDArray[np.int64]:
    """Keys of all voxels within half a voxel of points (N, 3), m, in each axis; some of them repeatedly."""
    # Just less than half a voxel: a cube as wide as a voxel could straddle three of them by rounding.
    margin = 0.499 * voxel
    lowest, highest = find_voxels(points - margin, voxel), find_voxels(points + margin, voxel)
    # Nearly all cubes straddle two voxels in each axis, the same as many others do.
    straddling = (highest == lowest + 1).all(axis=1)
    corners = pack_voxels(np.array(list(product((0, 1), repeat=3))))
    common = _sort_distinct(pack_voxels(lowest[straddling]))[:, None] + corners
    ends = np.stack([lowest[~straddling], highest[~straddling]])
    others = [
        pack_voxels(np.stack([ends[i, :, 0], ends[j, :, 1], ends[k, :, 2]], axis=-1))
        for i, j, k in product((0, 1), repeat=3)
    ]
    return np.concatenate([common.ravel(), *others])


def _sort_distinct(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """As ``np.unique``, which takes five times as long where most keys occur once."""
    keys = np.sort(keys)
    return keys[np.flatnonzero(np.diff(keys, prepend=-1))]

"""Backgrounds of scanners, learned from a window without target and operator.

Source: MSG-Cal, section III-A (change detection between octrees). In the plane of a 2-D scanner, a threshold on
the range of each beam serves the same purpose with a finer resolution.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from calgraph.config.settings import DetectionSettings, ScanBackgroundSettings
from calgraph.detection.cloud_background import CloudBackground, find_direction_cells, pack_voxel_keys
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import LaserScan, PointCloud, ScanBackground, align_ranges


def learn_scan_background(
    scans: Sequence[LaserScan], settings: ScanBackgroundSettings = ScanBackgroundSettings()
) -> ScanBackground:
    """Learns the background of a 2-D scanner.

    A low quantile of each beam's ranges is its background depth. At an edge, where a beam alternates between two
    depths or averages them, both and all between them are then background. The margin grows with the standard
    deviation of the beam's ranges.

    Args:
        scans: of one sensor; not necessarily with the same beams.
        settings: of the model.

    Raises:
        InputError: there are no scans, or no scan has a measurement.
    """
    if not any(scan.valid.any() for scan in scans):
        raise InputError("capture.background: no returns in this window; choose one with measurements")
    angles = np.sort(max(scans, key=lambda scan: len(scan.angles)).angles)
    ranges = np.concatenate([align_ranges(angles, scan.angles, scan.ranges[None]) for scan in scans])
    depths = _find_nearest_depths(ranges, settings.depth_quantile)
    # Only the scatter around the nearest depth: that of all ranges would be the size of the edge.
    offsets = np.where(np.abs(ranges - depths) < settings.noise_window, ranges - depths, np.nan)
    sigma = np.sqrt(np.nansum(offsets**2, axis=0) / np.maximum(np.isfinite(offsets).sum(axis=0), 1))
    margins = np.maximum(settings.min_margin, settings.margin_sigmas * sigma)
    return ScanBackground.from_depths(angles, depths, margins)


def _find_nearest_depths(ranges: Array, quantile: float) -> Array:
    """A low quantile of each column of (S, B) ranges, NaN ignored; NaN where a column has no range."""
    ordered = np.sort(ranges, axis=0)  # NaN last
    count = np.isfinite(ranges).sum(axis=0)
    row = np.floor(quantile * np.maximum(count - 1, 0)).astype(np.intp)
    return np.asarray(ordered[row, np.arange(ranges.shape[1])])


def learn_cloud_background(
    clouds: Iterable[PointCloud], settings: DetectionSettings = DetectionSettings()
) -> CloudBackground:
    """Learns the background of a 3-D scanner.

    Every point occupies all voxels within half a voxel of it, in each axis, so that noise at the border of a voxel
    does not turn background into foreground.

    Args:
        clouds: sweeps of one sensor; memory grows with the space they cover, not with their number.
        settings: of the model, and the least depth jump of the scanners.

    Raises:
        InputError: the clouds hold no points.
    """
    from scipy.ndimage import maximum_filter  # takes as long to import as all of NumPy

    voxel, cell = settings.cloud_background.voxel, settings.cloud_background.direction_cell
    keys = np.empty(0, dtype=np.int64)
    max_range = np.zeros((round(np.pi / cell), round(2 * np.pi / cell)))
    # Just less than half a voxel: a cube as wide as a voxel could straddle three of them by rounding.
    corners = 0.499 * voxel * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    for cloud in clouds:
        occupied = np.unique(pack_voxel_keys((cloud.points + corners).reshape(-1, 3), voxel))
        keys = np.union1d(keys, occupied)
        cells = find_direction_cells(cloud.points, max_range.shape)
        np.maximum.at(max_range, cells, np.linalg.norm(cloud.points, axis=1))
    if not len(keys):
        raise InputError("capture.background: no points in this window; choose one with measurements")
    max_range = maximum_filter(max_range, size=3, mode=["nearest", "wrap"])
    max_range = np.where(max_range > 0, max_range + settings.scanner.min_depth_jump, np.inf)
    return CloudBackground(voxel, keys, max_range)

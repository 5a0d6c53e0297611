"""Background model of a 2-D scanner: the smallest static range of each beam.

Source: MSG-Cal, section III-A (change detection between octrees). In the plane of a 2-D scanner, thresholding the
range of each beam does the same with a finer resolution.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors.messages import LaserScan

# Quantile of a beam's background ranges that counts as its nearest depth, and least margin before it, m.
_DEPTH_QUANTILE = 0.05
_MIN_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class ScanBackground:
    """Smallest range of each beam of a 2-D scanner without target and operator."""

    angles: Array
    """(B,) beam angles, ascending, rad."""
    min_ranges: Array
    """(B,) range below which a beam is foreground, m; inf for beams that never measured the background."""

    @staticmethod
    def build(scans: Iterable[LaserScan]) -> "ScanBackground":
        """Learns the model from scans taken while neither target nor operator were in view.

        A low quantile of each beam's ranges is its background depth. At an edge, where a beam alternates between
        two depths or averages them, both and all between them are then background. The limit of a beam is the
        smallest one of its neighbours and itself, because beam directions are noisy, too; the margin grows with
        the standard deviation of the beam's ranges.

        Raises:
            InputError: there are no scans, or no scan has a measurement.

        """
        all_scans = list(scans)
        if not any(scan.valid.any() for scan in all_scans):
            raise InputError("capture.background: no returns in this window; choose one with measurements")
        reference = max(all_scans, key=lambda scan: len(scan.angles))
        angles = np.sort(reference.angles)
        ranges = np.full((len(all_scans), len(angles)), np.nan)
        for row, scan in zip(ranges, all_scans, strict=True):
            row[find_nearest_beams(angles, scan.angles[scan.valid])] = scan.ranges[scan.valid]
        near = _nearest_depth(ranges)
        # Only the scatter around the nearest depth: that of all ranges would be the size of the edge.
        spread = np.where(np.abs(ranges - near) < 0.3, ranges - near, np.nan)
        sigma = np.sqrt(np.nansum(spread**2, axis=0) / np.maximum(np.isfinite(spread).sum(axis=0), 1))
        limit = np.where(np.isfinite(near), near - np.maximum(_MIN_MARGIN, 2.5 * sigma), np.inf)
        padded = np.pad(limit, 1, mode="edge")
        return ScanBackground(angles, np.minimum(limit, np.minimum(padded[:-2], padded[2:])))

    def foreground(self, scan: LaserScan) -> NDArray[np.bool_]:
        """(N,) mask of the beams of a scan that end clearly before the background."""
        return self.is_foreground(scan.angles, scan.ranges)

    def is_foreground(self, angles: Array, ranges: Array) -> NDArray[np.bool_]:
        """Mask (..., N) of ranges (..., N) clearly shorter than the background at beam angles (N,)."""
        limit = self.min_ranges[find_nearest_beams(self.angles, angles)]
        return np.asarray(np.isfinite(ranges) & (ranges < limit))


def _nearest_depth(ranges: Array) -> Array:
    """A low quantile of each column of (S, B) ranges, NaN ignored; NaN where a column has no range."""
    ordered = np.sort(ranges, axis=0)  # NaN last
    count = np.isfinite(ranges).sum(axis=0)
    row = np.floor(_DEPTH_QUANTILE * np.maximum(count - 1, 0)).astype(np.intp)
    return np.asarray(ordered[row, np.arange(ranges.shape[1])])


def find_nearest_beams(angles: Array, wanted: Array) -> NDArray[np.intp]:
    """Index of the nearest of the ascending ``angles`` (B,) for each wanted angle (N,)."""
    # Nearly all scans of a scanner have the same beams.
    if np.array_equal(angles, wanted):
        return np.arange(len(angles))
    right = np.clip(np.searchsorted(angles, wanted), 1, max(len(angles) - 1, 1))
    right = np.minimum(right, len(angles) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - angles[left] <= angles[right] - wanted, left, right)

"""How near each beam of a 2-D scanner ends while only the static surroundings are in view.

Source: MSG-Cal, section III-A (change detection between octrees); in the plane of a 2-D scanner the range of every
beam answers the same question more sharply.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors.messages import LaserScan

_DEPTH_QUANTILE = 0.05
_MIN_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class ScanBackground:
    """How near each beam of a 2-D scanner ends without target and operator."""

    angles: Array
    """(B,) beam angles, ascending, rad."""
    nearer_than: Array
    """(B,) range below which a beam is new, m; inf where the background never answered."""

    @staticmethod
    def build(scans: Iterable[LaserScan]) -> "ScanBackground":
        """Learns every beam from the scans taken while neither target nor operator were in view.

        The nearest depth that a beam shows in more than a few scans counts, so that at an edge, where a beam
        flickers between two depths or averages them, both and all between them are background. A beam also
        takes its neighbours' depths, because a beam's direction is noisy too; the margin grows with the beam's
        observed spread.

        Raises:
            InputError: there are no scans, or no beam ever measured anything.

        """
        all_scans = list(scans)
        if not any(scan.valid.any() for scan in all_scans):
            raise InputError("capture.background: no returns in this window; choose one with measurements")
        reference = max(all_scans, key=lambda scan: len(scan.angles))
        angles = np.sort(reference.angles)
        ranges = np.full((len(all_scans), len(angles)), np.nan)
        for row, scan in zip(ranges, all_scans, strict=True):
            row[nearest_beam(angles, scan.angles[scan.valid])] = scan.ranges[scan.valid]
        near = _nearest_depth(ranges)
        # The scatter around the nearest depth alone: that of a flickering beam would be the size of the edge.
        spread = np.where(np.abs(ranges - near) < 0.3, ranges - near, np.nan)
        sigma = np.sqrt(np.nansum(spread**2, axis=0) / np.maximum(np.isfinite(spread).sum(axis=0), 1))
        limit = np.where(np.isfinite(near), near - np.maximum(_MIN_MARGIN, 2.5 * sigma), np.inf)
        padded = np.pad(limit, 1, mode="edge")
        return ScanBackground(angles, np.minimum(limit, np.minimum(padded[:-2], padded[2:])))

    def foreground(self, scan: LaserScan) -> NDArray[np.bool_]:
        """Which beams of the scan end clearly before the background: (N,)."""
        return self.ends_before(scan.angles, scan.ranges)

    def ends_before(self, angles: Array, ranges: Array) -> NDArray[np.bool_]:
        """Which ranges (..., N) of beams at some angles (N,) are clearly shorter than the background's."""
        limit = self.nearer_than[nearest_beam(self.angles, angles)]
        return np.asarray(np.isfinite(ranges) & (ranges < limit))


def _nearest_depth(ranges: Array) -> Array:
    """A low quantile of each column of (S, B) ranges, NaN ignored; NaN where a column has no range."""
    ordered = np.sort(ranges, axis=0)  # NaN last
    count = np.isfinite(ranges).sum(axis=0)
    row = np.floor(_DEPTH_QUANTILE * np.maximum(count - 1, 0)).astype(np.intp)
    return np.asarray(ordered[row, np.arange(ranges.shape[1])])


def nearest_beam(angles: Array, wanted: Array) -> NDArray[np.intp]:
    """Index of the nearest of the ascending ``angles`` (B,) for each wanted angle (N,)."""
    # Nearly all scans of a scanner have the same beams.
    if np.array_equal(angles, wanted):
        return np.arange(len(angles))
    right = np.clip(np.searchsorted(angles, wanted), 1, max(len(angles) - 1, 1))
    right = np.minimum(right, len(angles) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - angles[left] <= angles[right] - wanted, left, right)

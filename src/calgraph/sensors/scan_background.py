"""Background model of a 2-D scanner: the range of each beam below which a return is foreground."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.sensors.messages import LaserScan


@dataclass(frozen=True, eq=False)
class ScanBackground:
    """Smallest range of each beam of a 2-D scanner without target and operator."""

    angles: Array
    """(B,) beam angles, ascending, rad."""
    min_ranges: Array
    """(B,) range below which a beam is foreground, m; inf for beams that never measured the background."""

    @staticmethod
    def from_depths(angles: Array, depths: Array, margins: Array) -> "ScanBackground":
        """The model of beams (B,) whose nearest background is at these depths, m.

        A beam also takes the limits of its neighbours: at an edge its direction is uncertain.

        Args:
            angles: (B,) ascending, rad.
            depths: (B,) m; NaN where a beam has no background.
            margins: (B,) least distance of foreground before the background, m.
        """
        limits = np.where(np.isfinite(depths), depths - margins, np.inf)
        padded = np.pad(limits, 1, mode="edge")
        return ScanBackground(angles, np.minimum(limits, np.minimum(padded[:-2], padded[2:])))

    def foreground(self, scan: LaserScan) -> NDArray[np.bool_]:
        """(N,) mask of the beams of a scan that end clearly before the background."""
        return self.is_foreground(scan.angles, scan.ranges)

    def is_foreground(self, angles: Array, ranges: Array) -> NDArray[np.bool_]:
        """Mask (..., N) of ranges (..., N) clearly shorter than the background at beam angles (N,)."""
        limit = self.min_ranges[find_nearest_beams(self.angles, angles)]
        return np.asarray(np.isfinite(ranges) & (ranges < limit))


def align_ranges(angles: Array, beam_angles: Array, ranges: Array) -> Array:
    """Assigns the values (S, N) of scans with beams (N,) to the nearest of ascending angles (B,).

    Returns:
        (S, B): NaN where no beam has a finite value; of several such beams the last one.
    """
    ranges = np.where(np.isfinite(ranges), ranges, np.nan)
    # Nearly all scans of a scanner have the same beams.
    if np.array_equal(angles, beam_angles):
        return ranges
    nearest = find_nearest_beams(angles, beam_angles)
    if np.array_equal(nearest, np.arange(len(angles))):
        return ranges
    aligned = np.full((len(ranges), len(angles)), np.nan)
    for beam, column in zip(nearest, ranges.T, strict=True):
        aligned[:, beam] = np.where(np.isfinite(column), column, aligned[:, beam])
    return aligned


def find_nearest_beams(angles: Array, wanted: Array) -> NDArray[np.intp]:
    """Index of the nearest of the ascending ``angles`` (B,) for each wanted angle (N,)."""
    if np.array_equal(angles, wanted):
        return np.arange(len(angles))
    right = np.clip(np.searchsorted(angles, wanted), 1, max(len(angles) - 1, 1))
    right = np.minimum(right, len(angles) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - angles[left] <= angles[right] - wanted, left, right)

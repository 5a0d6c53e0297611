"""What the scanners see without target and operator, and which measurements are new against it.

Source: MSG-Cal, section III-A (change detection between octrees). A hash of voxels answers the same question for
points, and in the plane of a 2-D scanner the range of every beam answers it more sharply.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import LaserScan, PointCloud

Mask = NDArray[np.bool_]

# Voxel indices are packed into one 64-bit key, 21 bits an axis: ±100 km at 10 cm.
_BITS = 21
_HALF = 1 << (_BITS - 1)

# Width of the direction cells that remember how far the background reaches, rad.
_DIRECTION = np.radians(1.0)
# How much farther than anything seen before a point must be to count as "behind the background", m.
_BEHIND = 0.10

_DEPTH_QUANTILE = 0.05
_MIN_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class CloudBackground:
    """The occupied space around a 3-D scanner."""

    voxel: float
    """Edge of a voxel, m."""
    keys: NDArray[np.int64]
    """(M,) sorted keys of all voxels within half a voxel of a background point."""
    reach: Array
    """(elevations, azimuths) farthest background range in and around each direction cell, m; inf where unknown."""

    @staticmethod
    def build(clouds: Iterable[PointCloud], voxel: float = 0.10) -> "CloudBackground":
        """Accumulates the sweeps taken while neither target nor operator were in view.

        Every point claims all voxels within half a voxel of it, in each axis, so that noise at a voxel's border
        does not let the background through.

        Args:
            clouds: sweeps of one sensor; memory grows with the space they cover, not with their number.
            voxel: edge of a voxel, m; noise up to half of it is absorbed.

        Raises:
            InputError: the clouds hold no points.

        """
        keys = np.empty(0, dtype=np.int64)
        reach = np.zeros((round(np.pi / _DIRECTION), round(2 * np.pi / _DIRECTION)))
        # Just less than half a voxel: a cube as wide as a voxel could straddle three of them by rounding.
        corners = (
            0.499 * voxel * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
        )
        for cloud in clouds:
            claimed = np.unique(_keys((cloud.points + corners).reshape(-1, 3), voxel))
            keys = np.union1d(keys, claimed)
            np.maximum.at(reach, _direction_cells(cloud.points, reach.shape), np.linalg.norm(cloud.points, axis=1))
        if not len(keys):
            raise InputError("capture.background: no points in this window; choose one with measurements")
        reach = maximum_filter(reach, size=3, mode=["nearest", "wrap"])
        return CloudBackground(voxel, keys, np.where(reach > 0, reach, np.inf))

    def foreground(self, points: Array) -> Mask:
        """Which of the points (N, 3), m, are neither at nor behind the background: (N,)."""
        keys = _keys(points, self.voxel)
        at = self.keys[np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)] == keys
        far = self.reach[_direction_cells(points, self.reach.shape)] + _BEHIND
        return np.asarray(~at & (np.linalg.norm(points, axis=1) < far))


def _keys(points: Array, voxel: float) -> NDArray[np.int64]:
    cells = np.clip(np.floor(points / voxel).astype(np.int64) + _HALF, 0, 2 * _HALF - 1)
    return np.asarray((cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2])


def _direction_cells(points: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of each point's direction from the sensor in a grid of elevations and azimuths."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = np.clip((elevation / np.pi + 0.5) * shape[0], 0, shape[0] - 1).astype(np.intp)
    column = ((azimuth / (2 * np.pi) + 0.5) * shape[1]).astype(np.intp) % shape[1]
    return row, column


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
            row[_nearest(angles, scan.angles[scan.valid])] = scan.ranges[scan.valid]
        near = _nearest_depth(ranges)
        # The scatter around the nearest depth alone: that of a flickering beam would be the size of the edge.
        spread = np.where(np.abs(ranges - near) < 0.3, ranges - near, np.nan)
        sigma = np.sqrt(np.nansum(spread**2, axis=0) / np.maximum(np.isfinite(spread).sum(axis=0), 1))
        limit = np.where(np.isfinite(near), near - np.maximum(_MIN_MARGIN, 2.5 * sigma), np.inf)
        padded = np.pad(limit, 1, mode="edge")
        return ScanBackground(angles, np.minimum(limit, np.minimum(padded[:-2], padded[2:])))

    def foreground(self, scan: LaserScan) -> Mask:
        """Which beams of the scan end clearly before the background: (N,)."""
        limit = self.nearer_than[_nearest(self.angles, scan.angles)]
        return np.asarray(scan.valid & (np.where(scan.valid, scan.ranges, np.inf) < limit))


def _nearest_depth(ranges: Array) -> Array:
    """A low quantile of each column of (S, B) ranges, NaN ignored; NaN where a column has no range."""
    ordered = np.sort(ranges, axis=0)  # NaN last
    count = np.isfinite(ranges).sum(axis=0)
    row = np.floor(_DEPTH_QUANTILE * np.maximum(count - 1, 0)).astype(np.intp)
    return np.asarray(ordered[row, np.arange(ranges.shape[1])])


def _nearest(angles: Array, wanted: Array) -> NDArray[np.intp]:
    """Index of the nearest of the ascending ``angles`` (B,) for each wanted angle (N,)."""
    right = np.clip(np.searchsorted(angles, wanted), 1, max(len(angles) - 1, 1))
    right = np.minimum(right, len(angles) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - angles[left] <= angles[right] - wanted, left, right)

"""Background model of a 3-D scanner: the space occupied without target and operator.

Source: MSG-Cal, section III-A (change detection between octrees). A hash of voxels serves the same purpose;
:class:`calgraph.sensors.ScanBackground` serves it for 2-D scanners.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, measure_lengths

Mask = NDArray[np.bool_]
Cells = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns of a grid of directions."""

# Voxel indices are packed into one 64-bit key, 21 bits an axis: ±100 km at 10 cm.
_BITS = 21
_HALF = 1 << (_BITS - 1)


@dataclass(frozen=True, eq=False)
class CloudBackground:
    """The occupied space around a 3-D scanner."""

    voxel: float
    """Edge of a voxel, m."""
    keys: NDArray[np.int64]
    """(M,) sorted keys of all voxels within half a voxel of a background point."""
    max_range: Array
    """(elevations, azimuths) range, m, beyond which points are behind the background, by direction cell; inf where
    the background has no point in or around it."""

    def foreground(self, points: Array) -> Mask:
        """Which of the points (N, 3), m, are neither at nor behind the background: (N,)."""
        keys = pack_voxels(find_voxels(points, self.voxel))
        in_background = self.keys[np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)] == keys
        max_range = self.max_range[find_direction_cells(points, self.max_range.shape)]
        return np.asarray(~in_background & (measure_lengths(points) < max_range))


def find_voxels(points: Array, voxel: float) -> NDArray[np.int64]:
    """Indices (N, 3), 0 and more, of the voxels that contain points (N, 3), m."""
    return np.clip(np.floor(points / voxel).astype(np.int64) + _HALF, 0, 2 * _HALF - 1)


def pack_voxels(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (N,) of voxels (N, 3)."""
    return np.asarray((voxels[:, 0] << 2 * _BITS) | (voxels[:, 1] << _BITS) | voxels[:, 2])


def find_direction_cells(points: Array, shape: tuple[int, ...]) -> Cells:
    """Row and column of each point's direction from the sensor in a grid of elevations and azimuths."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = np.clip((elevation / np.pi + 0.5) * shape[0], 0, shape[0] - 1).astype(np.intp)
    column = ((azimuth / (2 * np.pi) + 0.5) * shape[1]).astype(np.intp) % shape[1]
    return row, column


def find_local_maxima(grid: Array) -> Array:
    """The maximum of each cell (elevations, azimuths) and its eight neighbours."""
    by_elevation = np.pad(grid, ((1, 1), (0, 0)), mode="edge")
    rows = np.maximum(np.maximum(by_elevation[:-2], by_elevation[1:-1]), by_elevation[2:])
    around = np.pad(rows, ((0, 0), (1, 1)), mode="wrap")
    return np.asarray(np.maximum(np.maximum(around[:, :-2], around[:, 1:-1]), around[:, 2:]))

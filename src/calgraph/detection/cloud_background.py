"""Background subtraction for 3-D scanners: the space occupied without target and operator.

Source: MSG-Cal, section III-A (change detection between octrees). A hash of voxels serves the same purpose;
:class:`calgraph.sensors.ScanBackground` serves it for 2-D scanners.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import DetectionSettings
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import PointCloud

Mask = NDArray[np.bool_]

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

    @staticmethod
    def learn(
        clouds: Iterable[PointCloud], settings: DetectionSettings = DetectionSettings()
    ) -> "CloudBackground":
        """Accumulates the sweeps measured while neither target nor operator were in view.

        Every point occupies all voxels within half a voxel of it, in each axis, so that noise at the border of a
        voxel does not turn background into foreground.

        Args:
            clouds: sweeps of one sensor; memory grows with the space they cover, not with their number.
            settings: of the background, and the least depth jump of the scanners.

        Raises:
            InputError: the clouds hold no points.

        """
        from scipy.ndimage import maximum_filter  # takes as long to import as all of NumPy

        voxel, cell = settings.background.voxel, settings.background.direction_cell
        keys = np.empty(0, dtype=np.int64)
        max_range = np.zeros((round(np.pi / cell), round(2 * np.pi / cell)))
        # Just less than half a voxel: a cube as wide as a voxel could straddle three of them by rounding.
        corners = (
            0.499 * voxel * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
        )
        for cloud in clouds:
            occupied = np.unique(_pack_voxel_keys((cloud.points + corners).reshape(-1, 3), voxel))
            keys = np.union1d(keys, occupied)
            cells = _find_direction_cells(cloud.points, max_range.shape)
            np.maximum.at(max_range, cells, np.linalg.norm(cloud.points, axis=1))
        if not len(keys):
            raise InputError("capture.background: no points in this window; choose one with measurements")
        max_range = maximum_filter(max_range, size=3, mode=["nearest", "wrap"])
        max_range = np.where(max_range > 0, max_range + settings.scanner.min_depth_jump, np.inf)
        return CloudBackground(voxel, keys, max_range)

    def foreground(self, points: Array) -> Mask:
        """Which of the points (N, 3), m, are neither at nor behind the background: (N,)."""
        keys = _pack_voxel_keys(points, self.voxel)
        in_background = self.keys[np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)] == keys
        max_range = self.max_range[_find_direction_cells(points, self.max_range.shape)]
        return np.asarray(~in_background & (np.linalg.norm(points, axis=1) < max_range))


def _pack_voxel_keys(points: Array, voxel: float) -> NDArray[np.int64]:
    cells = np.clip(np.floor(points / voxel).astype(np.int64) + _HALF, 0, 2 * _HALF - 1)
    return np.asarray((cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2])


def _find_direction_cells(points: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of each point's direction from the sensor in a grid of elevations and azimuths."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = np.clip((elevation / np.pi + 0.5) * shape[0], 0, shape[0] - 1).astype(np.intp)
    column = ((azimuth / (2 * np.pi) + 0.5) * shape[1]).astype(np.intp) % shape[1]
    return row, column

"""The static scene around a 3-D scanner, learned from captures in which board and operator stood elsewhere.

A recording without a background window shows the scene behind the board in its other captures. A direction in
which most of them measure the same range, and few a longer one, ends on something static there.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import RangeNoise
from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array, measure_lengths
from calgraph.rig.detection.line_plane_fit import OUTLIER_SIGMAS
from calgraph.rig.detection.scan_averaging import MIN_THICKNESS
from calgraph.sensors import PointCloud

# Offset of the borders of direction cells, in cells. LiDARs have rings at whole and half degrees, at the border of
# cells of one degree: rounding would put the points of one ring in either of two rows.
_BORDER_OFFSET = 0.37


@dataclass(frozen=True, eq=False)
class CaptureBackground:
    """Ranges at which the static scene begins, by direction."""

    ranges: Array
    """(elevations, azimuths) m; infinite where it is not known."""

    def foreground(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (N, 3), m, are in front of the static scene: (N,)."""
        begin = self.ranges.ravel()[_find_cells(points, self.ranges.shape)]
        return np.asarray(measure_lengths(points) < begin)


# Edge of a direction cell, 1°: several beams of any LiDAR, and 5 cm at 3 m.
_DIRECTION_CELL = math.radians(1.0)
# Minimum share of the captures in which a static direction has the same range: board and operator cover a
# direction that they often stand in by less than a third of the captures, or it is not static.
_MIN_STATIC_SHARE = 0.7
# Maximum share of the captures with a longer range, or no return: one of 20. All beams of a cell are rarely lost
# together, and a board that stood elsewhere in two captures is not static.
_MAX_FREE_SHARE = 0.05


def learn_capture_background(
    clouds: Iterable[PointCloud], noise: RangeNoise, settings: DetectionSettings
) -> CaptureBackground:
    """Learns the static scene from one sweep of each capture; of few captures, nothing is known.

    If the sensor moved between captures, no direction has a static range. A board that stood in one place is
    static only if hardly any capture measured behind it. Empty clouds show nothing.

    Args:
        clouds: of one sensor, one a capture.
        noise: of a beam.
        settings: of the detection.
    """
    limits = settings.capture_background
    shape = round(np.pi / _DIRECTION_CELL) + 1, round(2 * np.pi / _DIRECTION_CELL)
    nearest = [
        _measure_nearest_ranges(cloud, shape, settings.lidar3d.min_range) for cloud in clouds if len(cloud.points)
    ]
    if len(nearest) < limits.min_captures:
        return CaptureBackground(np.full(shape, np.inf))
    ranges = np.sort(nearest, axis=0)  # directions without return last: they are infinite
    median = ranges[len(ranges) // 2]
    thickness = np.maximum(OUTLIER_SIGMAS * noise.at(median), MIN_THICKNESS)
    beyond = np.mean(ranges > median + thickness, axis=0)
    same = 1 - beyond - np.mean(ranges < median - thickness, axis=0)
    static = np.isfinite(median) & (same >= _MIN_STATIC_SHARE) & (beyond <= _MAX_FREE_SHARE)
    begin = np.where(static, median - thickness, np.inf)
    return CaptureBackground(begin.reshape(shape).astype(np.float64))


def _measure_nearest_ranges(cloud: PointCloud, shape: tuple[int, int], min_range: float) -> NDArray[np.float32]:
    """(elevations * azimuths,) m; infinite without returns."""
    ranges = measure_lengths(cloud.points)
    valid = ranges > min_range
    nearest = np.full(shape[0] * shape[1], np.inf, dtype=np.float32)
    np.minimum.at(nearest, _find_cells(cloud.points[valid], shape), ranges[valid].astype(np.float32))
    return nearest


def _find_cells(points: Array, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Index of the direction cell of each point (N, 3)."""
    x, y, z = points.T
    elevation, azimuth = np.arctan2(z, np.sqrt(x * x + y * y)), np.arctan2(y, x)  # hypot takes ten times as long
    row = (elevation / np.pi + 0.5) * (shape[0] - 1) + _BORDER_OFFSET
    column = ((azimuth / (2 * np.pi) + 0.5) * shape[1] + _BORDER_OFFSET).astype(np.intp)
    column[column == shape[1]] = 0  # the remainder of the division takes ten times as long
    return np.asarray(row.astype(np.intp) * shape[1] + column)


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
        # No voxel has a negative key: the last entry stands for keys above all others.
        in_background = np.append(self.keys, -1)[np.searchsorted(self.keys, keys)] == keys
        # Few points are outside of the background's voxels: only their directions are needed.
        foreground, outside = ~in_background, np.flatnonzero(~in_background)
        others = points.take(outside, axis=0)
        max_range = self.max_range[find_direction_cells(others, self.max_range.shape)]
        foreground[outside] = measure_lengths(others) < max_range
        return np.asarray(foreground)


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

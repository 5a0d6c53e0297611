"""Poses of a network's scanners in their common plane, with how their errors go together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se2
from calgraph.result import Calibration

_IN_PLANE = np.array([0, 1, 5])
# Variances of directions that nothing observes, m² and rad²: infinite ones cannot be inverted.
_UNKNOWN = 1e6


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Poses in the frame of the first scanner."""

    names: tuple[str, ...]
    T_root_scanner: Array
    """(N, 3, 3)."""
    covariance: Array
    """(3N, 3N) of the errors in the root's fixed axes; zero for the root."""

    def rows(self, names: Sequence[str]) -> Index:
        """(3M,) where the errors of these scanners stand in the covariance."""
        first = 3 * np.array([self.names.index(name) for name in names], dtype=np.intp)
        return np.asarray(first[:, None] + np.arange(3), dtype=np.intp).ravel()

    def of(self, names: Sequence[str]) -> "PlanarPoses":
        """The poses of some scanners, of which the first is the root."""
        rows = self.rows(names)
        return PlanarPoses(tuple(names), self.T_root_scanner[rows[::3] // 3], self.covariance[np.ix_(rows, rows)])

    def seen_from(self, name: str) -> "PlanarPoses":
        """The same poses in the frame of another scanner, which becomes the first."""
        moved = self.of([name, *(other for other in self.names if other != name)])
        T, count = moved.T_root_scanner, len(self.names)
        arm = T[:, :2, 2] - T[0, :2, 2]
        by_new = -np.tile(np.eye(3), (count, 1, 1))
        by_new[:, 0, 2], by_new[:, 1, 2] = arm[:, 1], -arm[:, 0]
        J = np.eye(3 * count)
        J[:, :3] += by_new.reshape(-1, 3)
        back = np.eye(3)
        back[:2, :2] = T[0, :2, :2].T
        J = np.kron(np.eye(count), back) @ J
        return PlanarPoses(moved.names, se2.inverse(T[0]) @ T, J @ moved.covariance @ J.T)

    def in_space(self) -> tuple[Array, Array]:
        """Poses (N, 4, 4) and their covariance (6N, 6N); the common plane is taken as exact."""
        return se2.to_se3(self.T_root_scanner), in_space(self.covariance)


def in_space(planar: Array) -> Array:
    """Covariance (6N, 6N) of poses in a common plane, which is taken as exact, from that in it (3N, 3N)."""
    rows = _rows_in_space(len(planar) // 3)
    spread = np.zeros((2 * len(planar), 2 * len(planar)))
    spread[np.ix_(rows, rows)] = planar
    return spread


def in_plane(T: Array) -> Array:
    """Poses (..., 3, 3) in the plane from those in space (..., 4, 4), whatever their height and tilt."""
    return se2.pose(np.arctan2(T[..., 1, 0], T[..., 0, 0]), T[..., :2, 3])


def planar_poses(calibration: Calibration) -> PlanarPoses:
    """The poses of a network's calibration.

    Without a joint covariance errors are taken as independent.

    Raises:
        InputError: it is not a network's.
    """
    kinds = {sensor.kind for sensor in calibration.sensors}
    if kinds != {"lidar2d"} or not (calibration.planar or len(calibration.sensors) == 1):
        raise InputError("needs the calibration of a network of 2-D scanners in one plane")
    count = len(calibration.sensors)
    rows = _rows_in_space(count)
    spread = calibration.joint_covariance
    if spread is None:
        spread = np.zeros((6 * count, 6 * count))
        for k, sensor in enumerate(calibration.sensors):
            spread[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = np.nan_to_num(sensor.covariance, posinf=_UNKNOWN)
    T = in_plane(np.array([sensor.T_root_sensor for sensor in calibration.sensors]))
    return PlanarPoses(tuple(sensor.name for sensor in calibration.sensors), T, spread[np.ix_(rows, rows)])


def _rows_in_space(count: int) -> Index:
    return np.asarray((6 * np.arange(count)[:, None] + _IN_PLANE).ravel(), dtype=np.intp)

"""Where the root is on the vehicle: its pose in the frame that exports are rooted at."""

from dataclasses import dataclass, field

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.result.sensor_pose import Verdict


def _unmeasured(rows: int, columns: int) -> Array:
    return np.full((rows, columns), np.nan)


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """The frame on the floor below the centre of an axle: x ahead, y to the left, z up."""

    frame: str
    """Its name, such as base_link."""
    axle: str
    """rear, front or middle."""
    verdict: Verdict
    T_base_root: Array = field(default_factory=lambda: _unmeasured(4, 4))
    """(4, 4); NaN where the drive does not determine it, and for coordinates that are neither measured nor stated:
    y, and z of rigs that scan one plane."""
    covariance: Array = field(default_factory=lambda: _unmeasured(6, 6))
    """(6, 6) of its error in the axes of the base, (translation, rotation), m and rad; NaN for what was not
    measured."""

    @property
    def known(self) -> bool:
        """Whether the drive determines it, but for single coordinates."""
        return bool(np.isfinite(self.T_base_root[:3, :3]).all())

    @property
    def missing(self) -> str:
        """The coordinates that are neither measured nor stated."""
        return "".join(axis for axis, value in zip("xyz", self.T_base_root[:3, 3], strict=True) if np.isnan(value))

    @property
    def stddev(self) -> Array:
        """(6,) along and about the axes of the base, m and rad; NaN for what was not measured."""
        return np.sqrt(np.diag(self.covariance))

    def complete(self, others: Array | None = None) -> Array:
        """``T_base_root`` (4, 4) with coordinates of another pose where none are known; 0 without one."""
        t = self.T_base_root[:3, 3]
        filled = np.zeros(3) if others is None else others[:3, 3]
        return se3.pose(self.T_base_root[:3, :3], np.where(np.isnan(t), filled, t))

"""The pose of one sensor, or of the root on a vehicle, with its verdict, and what rig.yaml states beyond it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.special import chdtri

from calgraph.config import Intrinsics
from calgraph.geometry import Array, se3
from calgraph.result.file_types import Distance, Finite, Flag
from calgraph.sensors.kinds import KindName

Grade = Literal["good", "weak", "unobservable"]
UNMEASURED_IN_PLANE = np.array([2, 3, 4])
"""Axes z, roll and pitch of a tangent vector: what a network in one plane does not measure."""


@dataclass(frozen=True)
class Verdict:
    """A verdict on a sensor's pose."""

    grade: Grade
    reason: str = ""
    """What contradicts the pose and which directions are weak, in words, and what would fix them, in clauses with
    semicolons between; of a good pose, where it is from if not from this recording."""


@dataclass(frozen=True)
class StatedPose:
    """Height and tilt of a scanner, which a network does not measure."""

    height: Distance | None = None
    """Of the scanner's origin above the floor, m; None where it is not stated."""
    roll: Finite = 0.0
    """Rotation about the levelled x axis of the scanner, rad; without the 180° of one mounted upside-down."""
    pitch: Finite = 0.0
    """Rotation about its levelled y axis, after the roll, rad."""
    inverted: Flag = False
    """Whether it is mounted upside-down."""


@dataclass(frozen=True, eq=False)
class SensorPose:
    """The pose of one sensor of a calibration."""

    name: str
    parent: str | None
    """The parent in the spanning tree; None for the root."""
    frame_id: str
    kind: KindName
    T_root_sensor: Array
    """(4, 4)."""
    verdict: Verdict
    clock_offset: float | None = None
    """Sensor clock minus root clock, s; None where it was not estimated."""
    clock_offset_stddev: float | None = None
    stated: StatedPose | None = None
    """Height, roll and pitch of a network's scanner, where rig.yaml states any of them."""
    intrinsics: Intrinsics | None = None
    """Of a camera whose intrinsics were estimated from the recording, with the joint solution's values."""
    covariance: Array = field(init=False, repr=False)
    """(6, 6) of the error in the root's fixed axes, (translation, rotation), m and rad; zero for the root, and NaN
    where nothing was measured. A view of the joint covariance, set by the calibration."""

    @property
    def measured_covariance(self) -> Array:
        """The covariance (6, 6) with zero where nothing was measured: z, roll and pitch of a network's scanner."""
        unmeasured = np.isnan(np.diag(self.covariance))
        return np.where(unmeasured | unmeasured[:, None], 0.0, self.covariance)

    @property
    def axis_stddev(self) -> Array:
        """(6,) along and about the sensor's axes, m and rad; zero where nothing was measured."""
        return stddev_along_axes(self.T_root_sensor, self.measured_covariance)

    @property
    def worst_stddev(self) -> tuple[float, float]:
        """The largest of these, m and rad: σ of the pose in all prints, which the tolerance limits."""
        return float(np.max(self.axis_stddev[:3])), float(np.max(self.axis_stddev[3:]))


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


def stddev_along_axes(T_root_sensor: Array, covariance: Array) -> Array:
    """(6,) standard deviations along and about a sensor's axes, m and rad; infinite where a direction is unknown.

    Args:
        T_root_sensor: (4, 4).
        covariance: (6, 6) in the root's fixed axes.
    """
    R = T_root_sensor[:3, :3]
    with np.errstate(invalid="ignore"):  # infinite times zero
        variances = np.array([np.diag(R.T @ covariance[k : k + 3, k : k + 3] @ R) for k in (0, 3)]).ravel()
    return np.sqrt(np.maximum(np.where(np.isnan(variances), np.inf, variances), 0))


def choose_axis_length(sensors: Sequence[SensorPose], longest: float) -> float:
    """Length of the axes of frames in pictures, m: clear of their neighbours, yet visible."""
    origins = np.array([sensor.T_root_sensor[:3, 3] for sensor in sensors])
    distances = np.linalg.norm(origins[:, None] - origins, axis=-1)
    np.fill_diagonal(distances, np.inf)
    spacing = np.median(distances.min(axis=1))
    return float(np.clip(0.4 * spacing, 0.05, longest)) if np.isfinite(spacing) else 0.25


# Standard deviations within which 95 % of a normal distribution in space lie: sqrt(χ²₃(0.95)).
_SCALE_95 = float(np.sqrt(chdtri(3, 0.05)))


def error_ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """The 95 % ellipsoid of a position with a covariance (3, 3), m²; unobservable directions are long.

    Returns:
        The semi-axes (3,), m, ascending, and the rotation (3, 3) from them to the frame of the covariance.
    """
    variances, axes = np.linalg.eigh(np.nan_to_num(covariance, nan=0.0, posinf=1e12, neginf=-1e12))
    return _SCALE_95 * np.sqrt(np.maximum(variances, 0)), axes * np.linalg.det(axes)

"""The pose of one sensor, with its verdict."""

from dataclasses import dataclass
from typing import Literal

from calgraph.geometry import Array

Grade = Literal["good", "weak", "unobservable"]


@dataclass(frozen=True)
class Verdict:
    """How far a sensor's pose can be relied on."""

    grade: Grade
    reason: str = ""
    """Which directions are weak, in words, and what would fix them; of a good pose, where it is from if not from
    this recording."""


@dataclass(frozen=True, eq=False)
class SensorPose:
    """Where one sensor is."""

    name: str
    parent: str | None
    """The sensor it hangs from in the spanning tree; None for the root."""
    frame_id: str
    kind: Literal["camera", "lidar2d", "lidar3d"]
    T_root_sensor: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of the error in the root's fixed axes, (translation, rotation), m and rad; zero for the root."""
    verdict: Verdict
    clock_offset: float | None = None
    """Sensor clock minus root clock, s; None where it was not estimated."""
    clock_offset_stddev: float | None = None

"""What is known of the poses of sensors while they are recorded, in rigs, networks and drives."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.result import Calibration, SensorPose
from calgraph.verdict.grades import max_good_stddev


@dataclass(frozen=True, eq=False)
class SensorSolution:
    """What is known of one sensor's pose."""

    name: str
    kind: str
    """camera, lidar2d or lidar3d."""
    T_root_sensor: Array | None = None
    """(4, 4); None as long as nothing connects the sensor to the root."""
    stddev: Array = field(default_factory=lambda: np.full(6, np.nan))
    """(6,) along and about the axes of the sensor, m and rad; zero for the root, and for axes that a network does
    not measure; NaN without a pose."""
    covariance: Array | None = None
    """(3, 3) of the position in the root's axes, m²; None without a pose."""
    uncertainty: float = float("inf")
    """Largest ratio of a standard deviation to the largest with which errors are within the tolerance."""
    grade: str = ""
    """good, weak or unobservable; empty without a pose."""
    reason: str = ""
    """Why it is not good, or not connected, in words."""
    clock_offset: float | None = None
    """Its clock minus the root's, s; None where that is not known."""
    tracks: int = 0
    """Of a network: number of tracks of people."""
    field_of_view: tuple[float, float] | None = None
    """Of a camera with intrinsics: horizontal and vertical, rad."""

    @property
    def progress(self) -> float:
        """1 where all errors are within the tolerance with the probability of verdicts, less before; 0..1."""
        return min(1.0, 1 / max(self.uncertainty, 1e-9))

    def express_in(self, T_plan_root: Array) -> "SensorSolution":
        """The same with its pose (4, 4) and covariance in another frame than the root's."""
        R = T_plan_root[:3, :3]
        T, covariance = self.T_root_sensor, self.covariance
        return replace(
            self,
            T_root_sensor=None if T is None else T_plan_root @ T,
            covariance=None if covariance is None else R @ covariance @ R.T,
        )

    @property
    def origin(self) -> Array:
        """(3,) in the frame of the root, m; of a sensor with a pose."""
        assert self.T_root_sensor is not None
        return self.T_root_sensor[:3, 3]


@dataclass(frozen=True, eq=False)
class Solution:
    """A calibration from what was recorded until some time."""

    sensors: tuple[SensorSolution, ...]
    """In the order of rig.yaml."""

    @property
    def posed(self) -> tuple[SensorSolution, ...]:
        """The sensors that have poses."""
        return tuple(one for one in self.sensors if one.T_root_sensor is not None)

    @property
    def done(self) -> bool:
        """Whether all sensors have good poses."""
        return bool(self.sensors) and all(one.grade == "good" for one in self.sensors)


def describe_sensors(rig: Rig, calibration: Calibration | None) -> tuple[SensorSolution, ...]:
    """What a calibration knows of all sensors; a root to which nothing is connected is no result."""
    poses = {one.name: one for one in calibration.sensors} if calibration and len(calibration.sensors) > 1 else {}
    unconnected: Mapping[str, str] = calibration.evidence.unconnected if calibration else {}
    limits = max_good_stddev(rig.tolerance, rig.settings.diagnostics.verdict)
    return tuple(
        _describe_pose(poses[name], limits)
        if name in poses
        else SensorSolution(name, spec.kind, reason=unconnected.get(name, ""))
        for name, spec in rig.sensors.items()
    )


def _describe_pose(sensor: SensorPose, limits: Array) -> SensorSolution:
    """What is known of a pose, with (6,) standard deviations up to which errors are within the tolerance."""
    return SensorSolution(
        sensor.name,
        sensor.kind,
        sensor.T_root_sensor,
        sensor.axis_stddev,
        sensor.measured_covariance[:3, :3],
        float(np.max(sensor.axis_stddev / limits)),
        sensor.verdict.grade,
        sensor.verdict.reason,
        sensor.clock_offset,
    )

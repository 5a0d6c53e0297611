"""2-D laser scanners: what rig.yaml states of them, and how their messages are recognised."""

from typing import Literal

import numpy as np

from calgraph.geometry import Array
from calgraph.io.quantities import DegreeStddev, Metres, Ratio, Tilt
from calgraph.sensors.kinds.sensor_kind import LEVEL_AXES, SensorKind, foxglove_types
from calgraph.sensors.kinds.stated import BeamError, RangeUncertainty, ScannerSpec
from calgraph.sensors.messages import LaserScan, Message, PointCloud


class Lidar2dUncertainty(RangeUncertainty):
    """Prior standard deviations of a 2-D scanner's systematic errors; 0 means exact."""

    angle_scale: Ratio = 0.002
    """Relative, of the stated angle increment. Drivers that divide the field of view by the number of beams,
    not by that of increments, are off by 0.1 % (1081 beams) to 0.3 % (361 beams)."""
    tilt: DegreeStddev = 2.0
    """Degrees, of the scan plane about each horizontal axis; only in networks, where it makes ranges longer than
    horizontal distances, by 0.06 % at 2° across the axis. Brackets are levelled by eye or with a spirit level."""
    clock_drift: Ratio = 3e-5
    """Relative error of the clock's rate; only in networks, beside the clock offset. Quartz oscillators of
    computers and scanners are specified to ±50 ppm over temperature: 3 ms in a minute."""

    def beam_errors(self) -> tuple[BeamError, ...]:
        """See :class:`RangeUncertainty`; also of the angle between beams."""
        wider = "angles between beams of {of} are {size} larger|smaller than stated"
        scale = BeamError("angle scale", "", self.angle_scale, 1.0, turn=_turn_by_azimuth, clause=wider)
        return *super().beam_errors(), scale


def _turn_by_azimuth(directions: Array) -> Array:
    rotations = np.zeros_like(directions)
    rotations[:, 2] = np.arctan2(directions[:, 1], directions[:, 0])
    return np.asarray(rotations, dtype=np.float64)


class Lidar2dSpec(ScannerSpec):
    """A 2-D laser scanner of the rig."""

    kind: Literal["lidar2d"] = "lidar2d"
    mounting: Literal["upright", "inverted"] | None = None
    """Of a network's scanner: inverted if it is mounted upside-down. Recognised from mirrored tracks if left out;
    the root is then taken as upright."""
    height: Metres | None = None
    """Of a network's scanner above the floor, m. It is not measured; exports state it relative to the root's."""
    roll: Tilt | None = None
    """Of a network's scanner about its levelled x axis, degrees; not measured, but exported. That of a scanner
    mounted upside-down is without the 180°."""
    pitch: Tilt | None = None
    """The same about its levelled y axis, degrees."""
    uncertainty: Lidar2dUncertainty = Lidar2dUncertainty()


# A cloud whose points are all closer to z = 0 than this is a scan, m.
_MAX_SCAN_HEIGHT = 1e-3


def _is_flat_cloud(message: Message) -> bool:
    """Some drivers publish the scans of 2-D scanners as flat clouds."""
    if not isinstance(message, PointCloud) or not len(message.points):
        return False
    return bool(np.abs(message.points[:, 2]).max() < _MAX_SCAN_HEIGHT)


LIDAR2D = SensorKind(
    name="lidar2d",
    title="2-D scanner",
    spec=Lidar2dSpec,
    messages=(LaserScan, PointCloud),
    types=(
        "sensor_msgs/msg/LaserScan",
        "sensor_msgs/msg/MultiEchoLaserScan",
        "scan",
        *foxglove_types("LaserScan"),
    ),
    detects="line",
    axes=LEVEL_AXES,
    shape="disc",
    color="#6fd3a5",
    default_name="laser",
    drafted_noise="{range: 0.02, angle: 0.001}",
    residual="distance from the board",
    noise_causes="check its range noise, and that its ranges and angles are in m and rad",
    error_causes="its range and angle noise, and that its ranges and angles are in m and rad",
    correction="true range = (range - range bias) / range scale; true angle = angle scale * angle",
    claims=_is_flat_cloud,
)

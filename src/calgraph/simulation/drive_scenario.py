"""The options of a simulated drive. Angles are in degrees."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from calgraph.errors import InputError
from calgraph.simulation.drive_motion import PathKind
from calgraph.simulation.drive_world import WorldKind

DriveSensorKind = Literal["lidar", "solid_state", "scanner", "odometry", "trajectory", "gyroscope", "camera"]
"""Spinning or solid-state 3-D LiDAR, 2-D scanner, wheel odometry, trajectory of a program, gyroscope, camera."""
RigName = Literal[
    "two_lidars", "three_lidars", "four_lidars", "lidar_and_solid_state", "lidar_and_scanner", "two_scanners",
    "lidar_and_odometry", "lidar_and_trajectory", "lidar_and_gyroscope", "mixed", "scanner_270",
    "trajectories", "cameras_and_lidar", "three_cameras",
]  # fmt: skip
DRIVE_KINDS: Mapping[DriveSensorKind, str] = {
    "lidar": "lidar3d", "solid_state": "lidar3d", "scanner": "lidar2d", "odometry": "trajectory",
    "trajectory": "trajectory", "gyroscope": "gyroscope", "camera": "camera",
}  # fmt: skip
"""The kinds by which rig.yaml calls them."""
RANGING = ("lidar", "solid_state", "scanner")
"""The kinds that measure ranges; the others state poses or rates."""


@dataclass(frozen=True)
class RangeErrors:
    """What is wrong with the ranges of scanners. Each scanner draws its values from these spreads."""

    noise: float = 0.010
    """Standard deviation of a range at perpendicular incidence, m."""
    grazing_noise: float = 0.4
    """By which it grows, times 1 / cos(incidence) - 1."""
    grazing_bias: float = 0.002
    """Standard deviation of a scanner's bias at 60 degrees of incidence; it is that times 1 / cos - 1, m."""
    dark_bias: float = 0.004
    """Standard deviation of a scanner's bias on black relative to grey surfaces, m."""
    bias: float = 0.02
    """Standard deviation of a scanner's constant bias, m."""
    scale: float = 0.0002
    """Standard deviation of a scanner's error of scale."""
    ring_bias: float = 0.003
    """Standard deviation of the bias of each ring of a LiDAR, m."""
    ring_elevation: float = 0.03
    """Standard deviation of the error of each ring's elevation, degrees."""
    direction_noise: float = 0.02
    """Standard deviation of a beam's azimuth, degrees."""
    quantum: float = 0.002
    """Ranges are multiples of this, m; 0 for none."""
    dropout: float = 0.005
    """Probability that a beam returns nothing; on dark and slanted surfaces it is larger."""
    mixed_pixels: float = 0.3
    """Probability that one of the two beams at a depth edge falls between the two depths."""


EXACT = RangeErrors(*12 * (0.0,))
"""No errors of ranges."""


@dataclass(frozen=True)
class CameraErrors:
    """What is wrong with cameras and boards. Each draws its values from these spreads."""

    corner: float = 0.1
    """Standard deviation of a detected corner, pixels; blur adds to it."""
    focal: float = 0.002
    """Standard deviation of the focal length relative to the stated one."""
    centre: float = 2.0
    """Standard deviation of the principal point from the stated one, pixels."""
    distortion: float = 1.0
    """Standard deviation of the displacement that the stated distortion lacks at the image's corner, pixels."""
    exposure: float = 0.004
    """s."""
    readout: float = 0.008
    """From the first to the last row, s."""
    stamp_jitter: float = 0.0005
    """Standard deviation of the stamp of an image, s."""
    print_scale: float = 0.002
    """Standard deviation of the relative scale of all prints, by one printer."""
    print_aspect: float = 0.001
    """Standard deviation of their ratio of width to height."""
    bow: float = 0.0007
    """Standard deviation of the bow of each board along each axis, m."""


@dataclass(frozen=True)
class DriveSensor:
    """A sensor of the robot."""

    name: str
    kind: DriveSensorKind = "lidar"
    bearing: float = 0.0
    """Of the middle of its field, counter-clockwise from ahead; its own x axis is elsewhere."""
    sector: float = 140.0
    """Width of its field. Of a solid-state LiDAR it is its horizontal field of view."""
    rate: float = 10.0
    """Nominal measurements per second; the true rate differs by some per mille."""
    step: float = 0.8
    """Between columns of a LiDAR or beams of a scanner."""
    rings: int = 16
    """Of a LiDAR: beams per column."""
    elevation: float = 15.0
    """Of the highest beam of a LiDAR; the lowest is as far below the horizon."""
    max_tilt: float = 30.0
    """Largest tilt of its plane from the horizon."""
    max_range: float = 60.0
    """m."""


def _apart(count: int, sector: float) -> tuple[DriveSensor, ...]:
    names = ("front", "left", "rear", "right") if count == 4 else ("front", "rear", "right")
    bearings = {2: (0.0, 180.0), 3: (0.0, 120.0, -120.0), 4: (0.0, 90.0, 180.0, -90.0)}[count]
    return tuple(
        DriveSensor(f"lidar_{name}", bearing=bearing, sector=sector)
        for name, bearing in zip(names, bearings, strict=False)
    )


def _cameras() -> tuple[DriveSensor, ...]:
    """Three cameras 120 degrees apart, which see no board together."""
    return tuple(
        DriveSensor(f"camera_{name}", "camera", bearing, 75.0, 10.0, max_tilt=15.0)
        for name, bearing in (("front", 0.0), ("left", 120.0), ("right", -120.0))
    )


_GYROSCOPE = DriveSensor("gyroscope", "gyroscope", rate=100.0)
_ODOMETRY = DriveSensor("odometry", "odometry", rate=50.0, max_tilt=0.0)
_TRAJECTORY = DriveSensor("trajectory", "trajectory", rate=30.0)
_SCANNER = DriveSensor("laser_rear", "scanner", 180.0, 160.0, 40.0, 0.5, 1, 0.0, 6.0, 30.0)
STANDARD_RIGS: dict[RigName, tuple[DriveSensor, ...]] = {
    "two_lidars": _apart(2, 130.0),
    "three_lidars": _apart(3, 80.0),
    "four_lidars": _apart(4, 56.0),
    "lidar_and_solid_state": (
        _apart(2, 130.0)[0],
        DriveSensor("livox_rear", "solid_state", 180.0, 70.0, 10.0, rings=6, elevation=12.5),
    ),
    "lidar_and_scanner": (_apart(2, 130.0)[0], _SCANNER),
    "two_scanners": (
        DriveSensor("laser_front", "scanner", 0.0, 160.0, 40.0, 0.5, 1, 0.0, 0.0, 30.0),
        DriveSensor("laser_rear", "scanner", 180.0, 160.0, 40.0, 0.5, 1, 0.0, 0.0, 30.0),
    ),
    "lidar_and_odometry": (_apart(2, 130.0)[0], _ODOMETRY),
    "lidar_and_trajectory": (_apart(2, 130.0)[0], _TRAJECTORY),
    "lidar_and_gyroscope": (_apart(2, 130.0)[0], _GYROSCOPE),
    "mixed": (*_apart(2, 130.0), _ODOMETRY, _TRAJECTORY, _GYROSCOPE),
    "trajectories": (_TRAJECTORY, replace(_TRAJECTORY, name="trajectory_rear", rate=20.0), _GYROSCOPE),
    "cameras_and_lidar": (DriveSensor("lidar", sector=240.0, step=1.6), *_cameras()),
    "three_cameras": _cameras(),
    "scanner_270": (DriveSensor("laser_front", "scanner", 0.0, 270.0, 40.0, 0.5, 1, 0.0, 0.0, 30.0), _ODOMETRY),
}
"""Sensors by name of the rig; those that measure ranges share no view, and the first is the root."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong with one sensor."""

    time: float = 0.5
    """When bump and jump occur, as a fraction of the recording."""
    bump: tuple[float, float] = (0.0, 0.0)
    """By how much it is displaced and rotated from then on, m and degrees."""
    clock_drift: float = 0.0
    """By how much its clock runs fast."""
    clock_jump: float = 0.0
    """By how much its clock is ahead from then on, s."""
    range_scale: float = 0.0
    """By how much its ranges are too long."""


@dataclass(frozen=True)
class DriveFaults(Faults):
    """What goes wrong with the last sensor that measures ranges or takes images, or with the last of all."""

    truck: bool = False
    """Whether a truck drives beside the robot."""


@dataclass(frozen=True)
class DriveScenario:
    """A robot, its sensors, and where it drives."""

    seed: int = 0
    duration: float = 60.0
    """s."""
    sensors: tuple[DriveSensor, ...] = STANDARD_RIGS["two_lidars"]
    """The first is the root."""
    path: PathKind = "ordinary"
    world: WorldKind | None = None
    """A room, a hall or a yard by the seed if left out."""
    max_clock_offset: float = 0.05
    """Of a sensor's clock relative to the root's, s."""
    no_shared_view: bool = True
    """Whether fields of sensors that measure ranges must not overlap."""
    people: int = 2
    cars: int = 1
    """That drive by, in halls and yards."""
    glass: int = 2
    """Panes."""
    stamp_jitter: float = 0.0002
    """Standard deviation of the stamp of a cloud or a scan, s; times of points are relative to it."""
    lost_messages: float = 0.002
    """Probability that a cloud or a scan is not recorded."""
    slip: float = 0.004
    """Sideways velocity per speed and turn rate, s."""
    bounce: float = 1.0
    """Size of the suspension's motion; none on planar paths."""
    errors: RangeErrors = field(default_factory=RangeErrors)
    boards: int = 6
    """Boards on walls, where the robot has cameras."""
    image_size: tuple[int, int] = (800, 600)
    """Of cameras, pixels."""
    camera_errors: CameraErrors = field(default_factory=CameraErrors)
    faults: DriveFaults = field(default_factory=DriveFaults)
    start_time: float = 1_700_000_000.0
    """Stamp at the start of the recording, s."""

    def __post_init__(self) -> None:
        """Checks the sensors.

        Raises:
            InputError: names are not unique, or all are gyroscopes.
        """
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names) or all(sensor.kind == "gyroscope" for sensor in self.sensors):
            raise InputError(
                f"a drive needs sensors with unique names, one at least that is no gyroscope, got {names}"
            )

    @property
    def faulty(self) -> str:
        """The sensor that faults concern."""
        seeing = [sensor.name for sensor in self.sensors if sensor.kind in (*RANGING, "camera")]
        return (seeing or [sensor.name for sensor in self.sensors])[-1]

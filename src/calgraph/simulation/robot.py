"""The simulated robot: its sensors, their poses, and their times of measurement."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.sensors.beam_pattern import BeamPattern, laser_pattern, multibeam_pattern, spinning_pattern
from calgraph.sensors.kinds import KINDS, KindName
from calgraph.simulation.rig_scenario import BeamOptions, CameraOptions, DepthOptions, RigScenario

# Optical axes (z forward, x right) of a camera that faces along the robot's x.
_R_BODY_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_LASER_NAMES = ("laser_front", "laser_left", "laser_right", "laser_back")
_LASER_YAWS = (0.0, 60.0, -60.0, 180.0)
# Directions (roll, pitch) of the tilts of neighbouring 2-D scanners, so that no two scan planes are parallel.
_LASER_TILTS = ((0.0, 1.0), (1.0, -0.4), (-1.0, -0.4), (0.3, 1.0))


@dataclass(frozen=True)
class SensorClock:
    """Times of a free-running sensor; measurement i starts at ``phase + i * period``."""

    phase: float
    """s from the start of the recording."""
    period: float
    """s."""
    duration: float
    """Of one measurement, s."""

    def start(self, index: int) -> float:
        """Start of a measurement, s."""
        return self.phase + index * self.period

    def first_after(self, time: float) -> int:
        """Index of the first measurement that starts at a time or later."""
        return max(0, int(np.ceil((time - self.phase) / self.period)))

    def within(self, start: float, end: float) -> range:
        """Indices of the measurements that lie fully between two times."""
        first = self.first_after(start)
        return range(first, max(first, int(np.floor((end - self.duration - self.phase) / self.period)) + 1))


@dataclass(frozen=True, eq=False)
class MountedSensor:
    """A sensor of the robot."""

    name: str
    kind: KindName
    T_world_sensor: Array
    """(4, 4)."""
    clock: SensorClock

    @property
    def frame_id(self) -> str:
        """The frame named in its messages."""
        return f"{self.name}_optical" if KINDS[self.kind].optical else self.name


@dataclass(frozen=True, eq=False)
class MountedCamera(MountedSensor):
    """A camera on the robot."""

    camera: CameraModel


@dataclass(frozen=True, eq=False)
class MountedScanner(MountedSensor):
    """A 2-D or 3-D scanner on the robot."""

    pattern: BeamPattern
    noise: BeamOptions


@dataclass(frozen=True, eq=False)
class MountedDepthCamera(MountedSensor):
    """A depth camera on the robot."""

    camera: CameraModel
    options: DepthOptions
    warp: tuple[float, float]
    """Constant errors of depths: of the whole image, and what its border has in addition, m at 1 m."""


RobotSensor = MountedCamera | MountedScanner | MountedDepthCamera


def build_robot(scenario: RigScenario, rng: np.random.Generator) -> tuple[RobotSensor, ...]:
    """Draws all sensors, near their nominal poses and with random phases; cameras first."""
    return (
        *_build_cameras(scenario, rng),
        *_build_spinning(scenario, rng),
        *_build_multibeams(scenario, rng),
        *_build_lasers(scenario, rng),
        *_build_depth_cameras(scenario, rng),
    )


def root_name(scenario: RigScenario, robot: tuple[RobotSensor, ...]) -> str:
    """The root sensor's name.

    Raises:
        InputError: the scenario names a root that the robot does not have.
    """
    names = [sensor.name for sensor in robot]
    if scenario.root is None:
        return next((sensor.name for sensor in robot if KINDS[sensor.kind].detects == "plane"), names[0])
    if scenario.root not in names:
        raise InputError(f"root {scenario.root!r} is not a sensor of this robot; it has {', '.join(names)}")
    return scenario.root


def hold_end(robot: tuple[RobotSensor, ...], start: float, measurements: int) -> float:
    """The end of a hold: every sensor has completed ``measurements`` measurements since its start, plus 0.1 s."""
    ends = [s.clock.start(s.clock.first_after(start) + measurements - 1) + s.clock.duration for s in robot]
    return max(ends) + 0.1


def camera_model(options: CameraOptions) -> CameraModel:
    """The camera with the stated field of view and its principal point at the middle of the image."""
    half = np.radians(options.field_of_view) / 2
    f = options.width / 2 / (half if options.model == "fisheye" else np.tan(half))
    K = np.array([[f, 0, (options.width - 1) / 2], [0, f, (options.height - 1) / 2], [0, 0, 1]])
    return CameraModel(options.model, options.width, options.height, K, np.array(options.distortion))


def _build_cameras(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedCamera]:
    options = scenario.camera
    for i in range(options.count):
        yaw = np.radians(60.0) * ((options.count - 1) / 2 - i)
        T_world_sensor = _draw_mount(scenario, rng, 0.2, 0.9, yaw)
        T_world_sensor[:3, :3] = T_world_sensor[:3, :3] @ _R_BODY_OPTICAL
        clock = _draw_clock(rng, 1 / options.rate, 0.0)
        yield MountedCamera(_number_name("camera", i), "camera", T_world_sensor, clock, camera_model(options))


def _build_depth_cameras(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedDepthCamera]:
    options = scenario.depth
    lens = CameraOptions(
        width=options.width, height=options.height, field_of_view=options.field_of_view,
        distortion=options.distortion,
    )  # fmt: skip
    for i in range(options.count):
        T_world_sensor = _draw_mount(scenario, rng, 0.3, 0.8, np.radians(60.0) * ((options.count - 1) / 2 - i))
        T_world_sensor[:3, :3] = T_world_sensor[:3, :3] @ _R_BODY_OPTICAL
        middle, border = rng.normal(0.0, options.warp, 2)
        clock = _draw_clock(rng, 1 / options.rate, 0.0)
        yield MountedDepthCamera(
            _number_name("depth", i), "depth_camera", T_world_sensor, clock, camera_model(lens), options,
            (float(middle), float(border)),
        )  # fmt: skip


def _build_spinning(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    options = scenario.spinning
    laser = laser_pattern(np.radians(options.field_of_view), np.radians(options.resolution), 1 / options.scan_rate)
    pattern = spinning_pattern(
        laser,
        1 / options.scan_rate,
        np.radians(options.tilt),
        options.offset,
        options.scans_per_degree,
        np.radians(options.scan_angle),
    )
    period = options.scan_angle * options.scans_per_degree / options.scan_rate
    for i in range(options.count):
        T_world_sensor = _draw_mount(scenario, rng, -0.5 * i, 1.1, 0.0)
        clock = _draw_clock(rng, period, float(pattern.times[-1]))
        yield MountedScanner(_number_name("lidar", i), "lidar3d", T_world_sensor, clock, pattern, options)


def _build_multibeams(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    options = scenario.multibeam
    elevations = np.radians(np.linspace(options.lowest, options.highest, options.rings))
    pattern = multibeam_pattern(elevations, np.radians(options.resolution), 1 / options.rate)
    for i in range(options.count):
        T_world_sensor = _draw_mount(scenario, rng, -0.3 - 0.5 * i, 1.0, 0.0)
        clock = _draw_clock(rng, 1 / options.rate, float(pattern.times[-1]))
        name = _number_name("lidar", scenario.spinning.count + i)
        yield MountedScanner(name, "lidar3d", T_world_sensor, clock, pattern, options)


def _build_lasers(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    options = scenario.laser
    pattern = laser_pattern(
        np.radians(options.field_of_view), np.radians(options.resolution), 1 / options.mirror_rate
    )
    for i in range(options.count):
        yaw = np.radians(_LASER_YAWS[i % len(_LASER_YAWS)])
        roll, pitch = np.radians(options.tilt) * np.array(_LASER_TILTS[i % len(_LASER_TILTS)])
        T_world_sensor = _draw_mount(scenario, rng, 0.35, 0.85, yaw)
        tilt = so3.exp(np.array([roll, pitch, 0.0]))
        T_world_sensor[:3, :3] = T_world_sensor[:3, :3] @ tilt
        name = _LASER_NAMES[i] if i < len(_LASER_NAMES) else f"laser_{i + 1}"
        clock = _draw_clock(rng, 1 / options.rate, float(pattern.times[-1]))
        yield MountedScanner(name, "lidar2d", T_world_sensor, clock, pattern, options)


def _draw_mount(scenario: RigScenario, rng: np.random.Generator, ahead: float, height: float, yaw: float) -> Array:
    """Draws a pose near the nominal one: at a distance from the robot's axis, facing outwards."""
    nominal = np.array([ahead * np.cos(yaw), ahead * np.sin(yaw), height])
    shift = rng.uniform(-1, 1, 3) * scenario.mount_position
    turn = rng.uniform(-1, 1, 3) * np.radians(scenario.mount_rotation)
    return se3.pose(so3.exp(np.array([0.0, 0.0, yaw])) @ so3.exp(turn), nominal + shift)


def _draw_clock(rng: np.random.Generator, period: float, duration: float) -> SensorClock:
    return SensorClock(float(rng.uniform(0, period)), period, duration)


def _number_name(name: str, index: int) -> str:
    return name if index == 0 else f"{name}_{index + 1}"

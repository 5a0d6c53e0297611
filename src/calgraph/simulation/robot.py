"""The simulated robot: its sensors, where they are, and when they measure."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.simulation.rig_scenario import BeamKnobs, CameraKnobs, RigScenario
from calgraph.simulation.scanners import (
    BeamNoise,
    BeamPattern,
    laser_pattern,
    multibeam_pattern,
    spinning_pattern,
)

_R_BODY_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_LASER_NAMES = ("laser_front", "laser_left", "laser_right", "laser_back")
_LASER_YAWS = (0.0, 60.0, -60.0, 180.0)
# Directions (roll, pitch) of the tilts of neighbouring 2-D scanners; no two scan planes are to be parallel.
_LASER_TILTS = ((0.0, 1.0), (1.0, -0.4), (-1.0, -0.4), (0.3, 1.0))


@dataclass(frozen=True)
class Clock:
    """When a free-running sensor measures; measurement i starts at ``phase + i * period``."""

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
        """Indices of the measurements that lie between two times in full."""
        first = self.first_after(start)
        return range(first, max(first, int(np.floor((end - self.duration - self.phase) / self.period)) + 1))


@dataclass(frozen=True, eq=False)
class Mounted:
    """What all sensors of the robot have."""

    name: str
    kind: Literal["camera", "lidar2d", "lidar3d"]
    T_world_sensor: Array
    """(4, 4)."""
    clock: Clock

    @property
    def frame_id(self) -> str:
        """The frame named in its messages."""
        return f"{self.name}_optical" if self.kind == "camera" else self.name


@dataclass(frozen=True, eq=False)
class MountedCamera(Mounted):
    """A camera on the robot."""

    camera: CameraModel


@dataclass(frozen=True, eq=False)
class MountedScanner(Mounted):
    """A 2-D or 3-D scanner on the robot."""

    pattern: BeamPattern
    noise: BeamNoise


RobotSensor = MountedCamera | MountedScanner


def build_robot(scenario: RigScenario, rng: np.random.Generator) -> tuple[RobotSensor, ...]:
    """All sensors, near their nominal places and with random phases; cameras first."""
    return (
        *_cameras(scenario, rng), *_spinning(scenario, rng), *_multibeams(scenario, rng), *_lasers(scenario, rng),
    )  # fmt: skip


def root_name(scenario: RigScenario, robot: tuple[RobotSensor, ...]) -> str:
    """The root sensor's name.

    Raises:
        InputError: the scenario names a root that the robot does not have.

    """
    names = [sensor.name for sensor in robot]
    if scenario.root is None:
        return next((sensor.name for sensor in robot if sensor.kind == "lidar3d"), names[0])
    if scenario.root not in names:
        raise InputError(f"root {scenario.root!r} is not a sensor of this robot; it has {', '.join(names)}")
    return scenario.root


def hold_end(robot: tuple[RobotSensor, ...], start: float, measurements: int) -> float:
    """When every sensor has measured so many times in full since a time, and a little later."""
    ends = [s.clock.start(s.clock.first_after(start) + measurements - 1) + s.clock.duration for s in robot]
    return max(ends) + 0.1


def camera_model(knobs: CameraKnobs) -> CameraModel:
    """The camera with the stated field of view and its principal point at the middle of the image."""
    half = np.radians(knobs.field_of_view) / 2
    f = knobs.width / 2 / (half if knobs.model == "fisheye" else np.tan(half))
    K = np.array([[f, 0, (knobs.width - 1) / 2], [0, f, (knobs.height - 1) / 2], [0, 0, 1]])
    return CameraModel(knobs.model, knobs.width, knobs.height, K, np.array(knobs.distortion))


def _cameras(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedCamera]:
    knobs = scenario.camera
    for i in range(knobs.count):
        yaw = np.radians(60.0) * ((knobs.count - 1) / 2 - i)
        place = _mount(scenario, rng, 0.2, 0.9, yaw)
        place[:3, :3] = place[:3, :3] @ _R_BODY_OPTICAL
        clock = _clock(rng, 1 / knobs.rate, 0.0)
        yield MountedCamera(_numbered("camera", i), "camera", place, clock, camera_model(knobs))


def _spinning(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    knobs = scenario.spinning
    laser = laser_pattern(np.radians(knobs.field_of_view), np.radians(knobs.resolution), 1 / knobs.scan_rate)
    pattern = spinning_pattern(
        laser,
        1 / knobs.scan_rate,
        np.radians(knobs.tilt),
        knobs.offset,
        knobs.scans_per_degree,
        np.radians(knobs.scan_angle),
    )
    period = knobs.scan_angle * knobs.scans_per_degree / knobs.scan_rate
    for i in range(knobs.count):
        place = _mount(scenario, rng, -0.5 * i, 1.1, 0.0)
        clock = _clock(rng, period, float(pattern.times[-1]))
        yield MountedScanner(_numbered("lidar", i), "lidar3d", place, clock, pattern, _noise(knobs))


def _multibeams(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    knobs = scenario.multibeam
    elevations = np.radians(np.linspace(knobs.lowest, knobs.highest, knobs.rings))
    pattern = multibeam_pattern(elevations, np.radians(knobs.resolution), 1 / knobs.rate)
    for i in range(knobs.count):
        place = _mount(scenario, rng, -0.3 - 0.5 * i, 1.0, 0.0)
        clock = _clock(rng, 1 / knobs.rate, float(pattern.times[-1]))
        name = _numbered("lidar", scenario.spinning.count + i)
        yield MountedScanner(name, "lidar3d", place, clock, pattern, _noise(knobs))


def _lasers(scenario: RigScenario, rng: np.random.Generator) -> Iterator[MountedScanner]:
    knobs = scenario.laser
    pattern = laser_pattern(np.radians(knobs.field_of_view), np.radians(knobs.resolution), 1 / knobs.mirror_rate)
    for i in range(knobs.count):
        yaw = np.radians(_LASER_YAWS[i % len(_LASER_YAWS)])
        roll, pitch = np.radians(knobs.tilt) * np.array(_LASER_TILTS[i % len(_LASER_TILTS)])
        place = _mount(scenario, rng, 0.35, 0.85, yaw)
        tilt = so3.exp(np.array([roll, pitch, 0.0]))
        place[:3, :3] = place[:3, :3] @ tilt
        name = _LASER_NAMES[i] if i < len(_LASER_NAMES) else f"laser_{i + 1}"
        clock = _clock(rng, 1 / knobs.rate, float(pattern.times[-1]))
        yield MountedScanner(name, "lidar2d", place, clock, pattern, _noise(knobs))


def _mount(scenario: RigScenario, rng: np.random.Generator, ahead: float, height: float, yaw: float) -> Array:
    """A pose near the nominal one: at a distance from the robot's axis, looking outwards."""
    nominal = np.array([ahead * np.cos(yaw), ahead * np.sin(yaw), height])
    shift = rng.uniform(-1, 1, 3) * scenario.mount_position
    turn = rng.uniform(-1, 1, 3) * np.radians(scenario.mount_rotation)
    return se3.pose(so3.exp(np.array([0.0, 0.0, yaw])) @ so3.exp(turn), nominal + shift)


def _clock(rng: np.random.Generator, period: float, duration: float) -> Clock:
    return Clock(float(rng.uniform(0, period)), period, duration)


def _noise(knobs: BeamKnobs) -> BeamNoise:
    return BeamNoise(
        range=knobs.range_noise,
        angle=knobs.angle_noise,
        mixed=knobs.mixed_pixels,
        dropout=knobs.dropout,
        min_range=knobs.min_range,
        max_range=knobs.max_range,
    )


def _numbered(name: str, index: int) -> str:
    return name if index == 0 else f"{name}_{index + 1}"

"""Random robots for random_rigs.py: kinds, models and poses of sensors."""

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor, SensorClock
from calgraph.simulation.scanners import (
    BeamPattern,
    SimulatedBeamNoise,
    laser_pattern,
    multibeam_pattern,
    spinning_pattern,
)

LAYOUTS = ("cluster", "ring", "spread", "back to back")
_R_BODY_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_SIZES = ((320, 240), (640, 480), (752, 480), (1280, 720), (1920, 1200))
_MAX_BEAMS = 8_000
"""Of one sweep, so that a recording takes seconds."""


def draw_robot(rng: np.random.Generator, small: bool, ordinary: bool) -> tuple[str, tuple[RobotSensor, ...]]:
    """The layout and its sensors: ``small`` ones have small, frequent messages, ``ordinary`` ones share a view."""
    layout = str(rng.choice(LAYOUTS, p=[0.55, 0.12, 0.25, 0.08]))
    layout = "cluster" if ordinary else layout
    count = int(rng.choice([2, 3, 4, 5, 6], p=[0.55, 0.3, 0.1, 0.03, 0.02]))
    noise = float(np.exp(rng.uniform(np.log(0.002), np.log(0.012 if ordinary else 0.04))))
    spacing = np.radians(rng.uniform(40, 100))
    robot: list[RobotSensor] = []
    for i in range(count):
        kind = str(rng.choice(["camera", "lidar2d", "lidar3d"], p=[0.45, 0.2, 0.35]))
        T = _draw_pose(rng, layout, i, count, spacing)
        name = f"{kind}_{i}"
        if kind == "camera":
            T = T @ se3.pose(_R_BODY_OPTICAL, np.zeros(3))
            robot.append(MountedCamera(name, "camera", T, SensorClock(0.0, 0.2, 0.0), draw_camera(rng, small)))
            continue
        pattern, period = _draw_laser(rng) if kind == "lidar2d" else _draw_lidar(rng, small)
        clock = SensorClock(0.0, period, float(pattern.times[-1]))
        of_beams = _draw_beam_noise(rng, noise)
        robot.append(
            MountedScanner(name, "lidar2d" if kind == "lidar2d" else "lidar3d", T, clock, pattern, of_beams)
        )
    return layout, tuple(robot)


def draw_camera(rng: np.random.Generator, small: bool) -> CameraModel:
    """Pinhole of 40 to 110 degrees, or fisheye of 110 to 180."""
    width, height = _SIZES[0 if small else rng.choice(len(_SIZES), p=[0.62, 0.3, 0.06, 0.015, 0.005])]
    shift = rng.normal(0, 0.01, 2) * width
    cx, cy = (width - 1) / 2 + shift[0], (height - 1) / 2 + shift[1]
    if rng.random() < 0.2:
        half = np.radians(rng.uniform(110, 180)) / 2
        f = width / 2 / half
        distortion = rng.normal(0, 1, 4) * [0.01, 0.003, 0.001, 0.0003]
        K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
        return CameraModel("fisheye", width, height, K, distortion)
    f = width / 2 / np.tan(np.radians(rng.uniform(40, 110)) / 2)
    K = np.array([[f, 0, cx], [0, f * (1 + rng.normal(0, 0.0005)), cy], [0, 0, 1]])
    # Up to 15 % at the corner of the image, where polynomials are then still monotonic.
    corner = np.hypot(width, height) / 2 / f
    k1 = rng.uniform(-0.15, 0.05) / corner**2
    five = np.array([k1, -0.2 * k1 / corner**2, *rng.normal(0, 0.0005, 2), 0.0])
    return CameraModel("pinhole", width, height, K, five if rng.random() < 0.8 else np.zeros(0))


def _draw_pose(rng: np.random.Generator, layout: str, index: int, count: int, spacing: float) -> Array:
    """``T_world_sensor`` (4, 4) of a sensor that faces along its x axis."""
    tilt = np.radians(rng.normal(0, 8, 2))
    roll = np.radians(180.0 if rng.random() < 0.12 else 90.0 if rng.random() < 0.05 else 0.0)
    position = np.array([rng.normal(0, 0.2), rng.normal(0, 0.3), rng.uniform(0.6, 1.5)])
    yaw = rng.normal(0, np.radians(15))
    if layout == "ring":
        yaw += spacing * (index - (count - 1) / 2)
        position[:2] += 0.3 * np.array([np.cos(yaw), np.sin(yaw)])
    elif layout == "spread":
        position[1] = rng.uniform(-2.5, 2.5)
        yaw += np.arctan2(-position[1], 3.0 - position[0])
    elif layout == "back to back" and index == 0:
        yaw += np.radians(rng.uniform(120, 240))
    turn = so3.exp(np.array([0.0, 0.0, yaw])) @ so3.exp(np.array([0.0, tilt[0], 0.0]))
    return se3.pose(turn @ so3.exp(np.array([roll + tilt[1], 0.0, 0.0])), position)


def _draw_laser(rng: np.random.Generator) -> tuple[BeamPattern, float]:
    field = rng.choice([rng.uniform(90, 180), 180.0, 270.0, 359.0])
    resolution = rng.choice([0.25, 1 / 3, 0.5, 1.0])
    return laser_pattern(np.radians(field), np.radians(resolution), 0.025), 0.1


def _draw_lidar(rng: np.random.Generator, small: bool) -> tuple[BeamPattern, float]:
    """A multi-beam LiDAR, or a 2-D scanner that spins."""
    if not small and rng.random() < 0.2:
        laser = laser_pattern(np.radians(270.0), np.radians(rng.choice([0.5, 1.0])), 0.02)
        tilt, offset = np.radians(rng.uniform(0, 10)), rng.uniform(0, 0.08)
        return spinning_pattern(laser, 0.02, tilt, offset, 1 / 3, float(np.pi)), 1.2
    rings = int(rng.choice([4, 8, 16, 32, 64], p=[0.08, 0.15, 0.45, 0.22, 0.1]))
    spread, middle = rng.uniform(15, 50) if rings > 4 else rng.uniform(3, 10), rng.uniform(-8, 4)
    elevations = np.radians(np.linspace(middle - spread / 2, middle + spread / 2, rings))
    finest = np.degrees(2 * np.pi) * rings / (_MAX_BEAMS / (3 if small else 1))
    return multibeam_pattern(elevations, np.radians(max(rng.uniform(0.15, 0.5), finest)), 0.1), 0.1


def _draw_beam_noise(rng: np.random.Generator, level: float) -> SimulatedBeamNoise:
    return SimulatedBeamNoise(
        range=level * float(np.exp(rng.normal(0, 0.3))),
        angle=float(rng.choice([0.0, rng.uniform(0, 0.002)])),
        mixed_pixels=float(rng.uniform(0, 0.5)),
        dropout=float(rng.choice([0.0, 0.005, rng.uniform(0, 0.2)])),
        min_range=0.1,
        max_range=float(rng.uniform(8, 60)),
    )

"""The rigs of model_errors.py."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from calgraph.geometry import se3, so3
from calgraph.sensors.beam_pattern import BeamPattern
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
)
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor

_CAMERA = CameraOptions(distortion=(-0.1, 0.03, 0.0005, -0.0005, 0.0))
_CHAIN_FACING = {"laser_front": 100.0, "camera": 40.0, "lidar": -20.0, "camera_2": -80.0}
"""Directions in which the sensors of the chain face, degrees to the left of ahead."""
_CHAIN_FIELD = 100.0
"""Their fields of view, degrees: neighbours share 40 degrees, others nothing."""

SCENARIOS: Mapping[str, RigScenario] = {
    "five": RigScenario(camera=_CAMERA),
    "chain": RigScenario(
        camera=_CAMERA.model_copy(update={"count": 2, "field_of_view": _CHAIN_FIELD}),
        laser=LaserOptions(count=1, field_of_view=_CHAIN_FIELD, range_noise=0.008),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1),
        # Around and around, so that every sensor measures before and after a bump; mostly before the 2-D scanner.
        bearings=(58, 0, -60, 70, 10, -50, 82, 20, -40, 64, 76),
        radii=(2.0, 2.8),
        samples=3,
        max_rotation=45.0,
    ),
    "pair": RigScenario(
        camera=_CAMERA,
        laser=LaserOptions(count=0),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1),
        bearings=(-30, -20, -10, 0, 10, 20, 30),
        samples=3,
    ),
    "cameras": RigScenario(
        camera=_CAMERA.model_copy(update={"count": 3, "field_of_view": _CHAIN_FIELD}),
        laser=LaserOptions(count=0),
        spinning=SpinningOptions(count=0),
        bearings=(-50, -40, -30, -20, -10, 10, 20, 30, 40, 50),
    ),
}
"""Five sensors; four in a chain, each of which detects the board together with its neighbours only; a camera with
a 16-beam LiDAR; and three cameras."""


@lru_cache(maxsize=4)
def rig_world(rig: str, seed: int, changes: tuple[tuple[str, Any], ...] = ()) -> World:
    """The world of a rig, with changes to its scenario."""
    world = build_world(SCENARIOS[rig].model_copy(update=dict(changes)), seed, images=False)
    if rig != "chain":
        return world
    nominal = {"camera": 30.0, "camera_2": -30.0, "laser_front": 0.0, "lidar": 0.0}
    robot = [
        _turned(sensor, np.radians(_CHAIN_FACING[sensor.name] - nominal[sensor.name])) for sensor in world.robot
    ]
    return replace(world, robot=tuple(robot))


def _turned(sensor: RobotSensor, yaw: float) -> RobotSensor:
    """The sensor carried around the robot's axis; a LiDAR with its field of view limited to a sector."""
    T_world_sensor = se3.pose(so3.exp(np.array([0.0, 0.0, yaw])), np.zeros(3)) @ sensor.T_world_sensor
    if isinstance(sensor, MountedScanner) and sensor.kind == "lidar3d":
        return replace(sensor, T_world_sensor=T_world_sensor, pattern=_sector(sensor.pattern))
    return replace(sensor, T_world_sensor=T_world_sensor)


def _sector(pattern: BeamPattern) -> BeamPattern:
    """The beams within half a field of view of the x axis."""
    # The last beams of the sector have themselves as neighbours: their fields of view end, not the board.
    return pattern.select(np.abs(np.angle(np.exp(1j * pattern.angles))) <= np.radians(_CHAIN_FIELD / 2))


def cameras_of(world: World) -> list[MountedCamera]:
    """The cameras of a robot."""
    return [sensor for sensor in world.robot if isinstance(sensor, MountedCamera)]


def scanners_of(world: World) -> list[MountedScanner]:
    """The scanners of a robot."""
    return [sensor for sensor in world.robot if isinstance(sensor, MountedScanner)]


def ring_count(scanner: MountedScanner) -> int:
    """Number of rings of a multi-beam LiDAR; 0 of other scanners."""
    return 0 if scanner.pattern.rings is None else int(scanner.pattern.rings.max()) + 1

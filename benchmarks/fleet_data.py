"""Simulated recordings of a fleet: broken files, and sensors that were moved between two recordings.

Each robot has a camera and two LiDARs, mounted differently, and two recordings of 24 captures, a day apart, of
different walks in different rooms.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.io.text_writing import save_yaml
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    simulate_rig,
)
from calgraph.simulation.robot import RobotSensor

SENSORS = ("lidar", "camera", "lidar_2")
BREAKS = ("truncated", "no recording", "empty")
SCENARIO = RigScenario(
    camera=CameraOptions(width=1280, height=960, texels_per_mm=1, rate=5, noise=0.5),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=2, range_noise=0.005, rate=5, resolution=0.4),
    bearings=(-30, 0, 30),
    radii=(1.4, 2.0),
    samples=4,
    max_rotation=45,
    background=2.0,
    hold_time=0.65,
    move_time=0.3,
    clutter=2,
)
_DAY = 86400.0


@dataclass(frozen=True)
class FleetPlan:
    """What is wrong with which robot of a simulated fleet."""

    robots: tuple[str, ...]
    broken: Mapping[str, str]
    """How the second recording of a robot is broken."""
    moved: Mapping[str, str]
    """The sensor of a robot that was moved between its two recordings."""


def plan_fleet(count: int, broken: int, moved: int, seed: int) -> FleetPlan:
    """Draws robots with broken recordings, and others with a moved sensor."""
    rng = np.random.default_rng([seed, 0])
    robots = tuple(f"robot-{k:02d}" for k in range(count))
    chosen = rng.choice(count, broken + moved, replace=False).tolist()
    return FleetPlan(
        robots,
        {robots[k]: BREAKS[i % len(BREAKS)] for i, k in enumerate(chosen[:broken])},
        {robots[k]: str(rng.choice(SENSORS)) for k in chosen[broken:]},
    )


def write_fleet(plan: FleetPlan, folder: Path, seed: int, distance: float) -> None:
    """Writes what is missing of the recordings of all robots, and fleet.yaml.

    Args:
        plan: what is wrong with which robot.
        folder: of the fleet.
        seed: of all that is drawn.
        distance: by which sensors are moved, m.
    """
    for number, robot in enumerate(plan.robots):
        done = folder / robot / "complete"
        if not done.exists():
            shutil.rmtree(folder / robot, ignore_errors=True)
            _write_robot(folder / robot, robot, plan, [seed, 1, number], distance)
            done.touch()
    save_fleet(folder / "fleet.yaml", plan.robots)


def save_fleet(path: Path, robots: Sequence[str]) -> None:
    """Writes a fleet.yaml of some of the robots, into their folder."""
    content = {
        "rig": "{robot}/day-0/rig.yaml",
        "recordings": ["{robot}/day-0/recording", "{robot}/day-1/recording"],
        "action": "calibrate",
        "robots": {robot: {} for robot in robots},
    }
    save_yaml(path, content)


def _write_robot(folder: Path, name: str, plan: FleetPlan, seed: Sequence[int], distance: float) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.integers(2**31, size=2).tolist()
    robot = build_world(SCENARIO, first, images=False).robot
    simulate_rig(SCENARIO, folder / "day-0", first, robot=robot)
    if name in plan.moved:
        direction = rng.normal(size=3)
        step = distance * direction / np.linalg.norm(direction)
        robot = tuple(_displace(one, step) if one.name == plan.moved[name] else one for one in robot)
    later = SCENARIO.model_copy(update={"start_time": SCENARIO.start_time + _DAY})
    simulate_rig(later, folder / "day-1", second, robot=robot)
    if name in plan.broken:
        _break_recording(next((folder / "day-1" / "recording").glob("*.mcap")), plan.broken[name])


def _displace(sensor: RobotSensor, step: Array) -> RobotSensor:
    T_step = se3.pose(np.eye(3), step)
    return replace(sensor, T_world_sensor=sensor.T_world_sensor @ T_step)


def _break_recording(file: Path, how: str) -> None:
    content = file.read_bytes()
    broken = {"truncated": content[: len(content) // 3], "no recording": b"not a recording\n" * 100, "empty": b""}
    file.write_bytes(broken[how])

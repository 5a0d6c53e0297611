"""Sensors of a hall: where installers put them, their patterns of beams, and their clocks."""

from dataclasses import dataclass, replace

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se3, so3
from calgraph.simulation.drive_beams import Columns, spread_columns, spread_rings
from calgraph.simulation.drive_robot import DriveClock
from calgraph.simulation.drive_scenario import DriveSensor
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_world import Hall
from calgraph.simulation.solids import cast_rays

_HEIGHTS, _HIGH = (2.0, 4.0), (4.0, 6.0)
"""Of LiDARs over the floor, m."""
_MAX_TILT = 40.0
"""Of the axis of a LiDAR, degrees."""
_SCANNER_TILT = 3.0
"""Of the plane of a 2-D scanner from level at most, degrees."""
_AIM_ERROR, _ROLL = 6.0, 5.0
"""Standard deviations of the elevation at which an installer points a LiDAR, and of its roll, degrees."""
_UPSIDE_DOWN = 0.2
"""Probability."""
_AREA, _MIN_FLOOR, _MIN_PEOPLE = 2.0, 0.25, 0.6
"""Edge of half of the area in the middle that all LiDARs cover, m; least shares of its floor, and of people there
from 0.9 to 1.8 m, in the field of each."""
_DRAWS = 500
_SWING_PERIODS, _SWING_STEPS = (1.0, 4.0), 12
"""Of a LiDAR that swings, s, and poses on each side that stand for all."""
_TURN_TIME = 0.97
"""Share of its period in which a solid-state LiDAR measures."""


@dataclass(frozen=True, eq=False)
class HallMount:
    """A sensor of the hall."""

    sensor: DriveSensor
    poses: tuple[Array, ...]
    """(4, 4) T_world_sensor: one, the one before and the one after a bump, or those of a sensor that swings."""
    columns: Columns
    """Of a sweep that starts at 0."""
    clock: DriveClock
    swing_period: float = 0.0
    """s; 0 for none."""

    def pose_of(self, starts: Array) -> Index:
        """(K,) the pose at times (K,), s."""
        if self.swing_period:
            phase = np.sin(2 * np.pi * starts / self.swing_period)
            return np.rint((phase + 1) / 2 * (len(self.poses) - 1)).astype(np.intp)
        return np.minimum(starts > self.clock.fault, len(self.poses) - 1).astype(np.intp)


def mount_sensors(scenario: HallScenario, hall: Hall, rng: np.random.Generator) -> tuple[HallMount, ...]:
    """Draws all sensors, LiDARs first, around the hall.

    Raises:
        InputError: no pose of a LiDAR was found from which it covers the middle of the hall.
    """
    mounts = []
    turn = rng.uniform()
    for index, sensor in enumerate(scenario.sensors):
        clock = draw_clock(scenario, sensor, index == 0, rng)
        columns = draw_columns(sensor, clock.period, rng)
        scanner = index - len(scenario.lidars)
        for _ in range(_DRAWS):
            place = _draw_place(hall, turn + index / len(scenario.sensors) + rng.normal(0, 0.05), rng)
            if scanner >= 0:
                T = _aim_scanner(hall, place, scenario.scanners[scanner], rng)
                break
            height = rng.uniform(*(_HIGH if scenario.high else _HEIGHTS))
            T = _aim_lidar(hall, sensor, place, min(height, float(hall.size[2]) - 0.5), rng)
            if _covers_middle(hall, sensor, T):
                break
        else:
            raise InputError(f"no pose of {sensor.name} was found in {_DRAWS} from which it covers the hall")
        mounts.append(_disturb(scenario, HallMount(sensor, (T,), columns, clock), rng))
    return tuple(mounts)


def draw_clock(scenario: HallScenario, sensor: DriveSensor, root: bool, rng: np.random.Generator) -> DriveClock:
    """A clock within the bounds of the scenario, and the phase and rate of sweeps."""
    faulty = sensor.name == scenario.faulty
    period = (1 + rng.uniform(-1e-3, 1e-3)) / sensor.rate
    return DriveClock(
        offset=0.0 if root else rng.uniform(-1, 1) * scenario.max_clock_offset,
        drift=rng.normal(0, 3e-6) + scenario.faults.clock_drift * faulty,
        jump=scenario.faults.clock_jump * faulty,
        period=period,
        phase=rng.uniform(0, period),
        middle=scenario.duration / 2,
        fault=scenario.faults.time * scenario.duration,
    )


def draw_columns(sensor: DriveSensor, period: float, rng: np.random.Generator) -> Columns:
    """The pattern of a sweep: columns from right to left, or from left to right."""
    angles = spread_columns(sensor)
    count = len(angles)
    share = _TURN_TIME if sensor.kind == "solid_state" else sensor.sector / 360
    spin, begin = rng.choice([-1.0, 1.0]), rng.uniform(-np.pi, np.pi) * (sensor.kind == "lidar")
    spin = 1.0 if sensor.kind == "scanner" else spin
    return Columns(
        np.arange(count) / (count - 1) * share * period,
        (begin + spin * angles + np.pi) % (2 * np.pi) - np.pi,
        np.tile(np.radians(sensor.elevation) * spread_rings(sensor), (count, 1)),
    )


def _draw_place(hall: Hall, around: float, rng: np.random.Generator) -> Array:
    """(2,) near a wall, some way around the hall (a turn is 1), and clear of furniture."""
    half = hall.size[:2] / 2 - 0.35
    for _ in range(_DRAWS):
        angle = 2 * np.pi * (around + rng.normal(0, 0.03))
        toward = np.array([np.cos(angle), np.sin(angle)])
        place = np.asarray(toward * np.min(half / np.maximum(np.abs(toward), 1e-9)) * rng.uniform(0.9, 1.0))
        if all(np.hypot(*(place - one[:2])) > one[2] + 0.5 for one in hall.furniture):
            break
    return place


def _aim_lidar(hall: Hall, sensor: DriveSensor, place: Array, height: float, rng: np.random.Generator) -> Array:
    """T_world_sensor of a LiDAR that an installer points at the middle of the hall."""
    target = rng.normal(0, 1.0, 2)
    base = float(hall.ground(place[None])[0])
    away = target - place
    yaw = np.arctan2(away[1], away[0])
    # Below the horizon; rings above the middle of the field are of the walls, and below it of the floor.
    aim = np.arctan2(height - rng.uniform(0.0, 1.2), np.hypot(*away)) + np.radians(rng.normal(0, _AIM_ERROR))
    pitch = float(np.clip(aim, 0, np.radians(_MAX_TILT)))
    R = so3.exp(np.array([0, 0, yaw])) @ so3.exp(np.array([0, pitch, 0.0]))
    R = R @ so3.exp(np.array([np.radians(rng.normal(0, _ROLL)) + np.pi * (rng.random() < _UPSIDE_DOWN), 0.0, 0.0]))
    if sensor.kind == "lidar":
        R = R @ so3.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return se3.pose(R, np.append(place, base + height))


def _aim_scanner(hall: Hall, place: Array, height: float, rng: np.random.Generator) -> Array:
    """T_world_sensor of a scanner that is level but for some degrees, and upside down sometimes."""
    yaw, axis = np.arctan2(-place[1], -place[0]) + rng.normal(0, 0.2), rng.uniform(-np.pi, np.pi)
    tilt = np.radians(rng.uniform(0, _SCANNER_TILT)) * np.array([np.cos(axis), np.sin(axis), 0.0])
    flip = np.array([np.pi * (rng.random() < _UPSIDE_DOWN), 0.0, 0.0])
    R = so3.exp(np.array([0, 0, yaw])) @ so3.exp(tilt) @ so3.exp(flip)
    return se3.pose(R, np.append(place, float(hall.ground(place[None])[0]) + height))


def _covers_middle(hall: Hall, sensor: DriveSensor, T_world_sensor: Array) -> bool:
    """Whether enough of the middle of the hall, and of people there, is in the field, and not hidden."""
    grid = np.linspace(-_AREA, _AREA, 9)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    heights = hall.ground(xy)[:, None] + [0.02, 0.9, 1.2, 1.5, 1.8]
    points = np.column_stack([np.repeat(xy, 5, axis=0), heights.ravel()])
    x, y, z = se3.apply(se3.inverse(T_world_sensor), points).T
    elevation, azimuth = np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))
    away = points - T_world_sensor[:3, 3]
    distance = np.linalg.norm(away, axis=1)
    hits = cast_rays(
        [one for one in hall.surfaces if not one.glass], T_world_sensor[None, :3, 3], away / distance[:, None]
    )
    within = (np.abs(elevation) < sensor.elevation) & (np.abs(azimuth) < sensor.sector / 2)
    visible = (within & (hits.ranges > distance - 0.05)).reshape(-1, 5)
    return bool(visible[:, 0].mean() > _MIN_FLOOR and visible[:, 1:].mean() > _MIN_PEOPLE)


def _disturb(scenario: HallScenario, mount: HallMount, rng: np.random.Generator) -> HallMount:
    """A sensor that is bumped or swings, if it is the faulty one."""
    faults, T = scenario.faults, mount.poses[0]
    if mount.sensor.name != scenario.faulty or not (any(faults.bump) or faults.swing):
        return mount
    metres, degrees = faults.bump
    move, axis = rng.normal(size=3), rng.normal(size=3)
    if any(faults.bump):
        turn = so3.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
        after = se3.pose(turn @ T[:3, :3], T[:3, 3] + metres * move / np.linalg.norm(move))
        return replace(mount, poses=(T, after))
    level = np.array([axis[0], axis[1], 0.0]) / np.hypot(axis[0], axis[1])
    angles = np.radians(faults.swing) * np.linspace(-1, 1, 2 * _SWING_STEPS + 1)
    poses = tuple(se3.pose(so3.exp(angle * level) @ T[:3, :3], T[:3, 3]) for angle in angles)
    return replace(mount, poses=poses, swing_period=rng.uniform(*_SWING_PERIODS))

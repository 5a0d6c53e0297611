"""Simulation of stationary 3-D LiDARs, and 2-D scanners, in a hall with walking people, and the ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se3, so3
from calgraph.recording.record_list import IndexedRecording
from calgraph.sensors import LaserScan, PointCloud, RecordedMessage
from calgraph.simulation.drive_beams import Columns, draw_scanner_errors
from calgraph.simulation.drive_robot import DriveClock
from calgraph.simulation.drive_scenario import DriveSensor
from calgraph.simulation.hall_beams import simulate_sweeps
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_world import Hall, build_hall
from calgraph.simulation.solids import Solid, cast_rays

_HEIGHTS, _HIGH = (2.0, 4.0), (4.0, 6.0)
"""Of LiDARs over the floor, m."""
_MAX_TILT = 40.0
"""Of the axis of a LiDAR, degrees."""
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
_STAMP_JITTER, _LOST_MESSAGES = 0.0002, 0.002
"""Standard deviation of stamps, s, and probability that a message is not recorded, as in drives."""
_LATENCIES = 0.002, 0.02
"""From the end of a measurement to its arrival at the recorder, s."""
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


@dataclass(frozen=True, eq=False)
class HallTruth:
    """The ground truth."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor, at the end where one was bumped, and in the middle where one swings."""
    clock_offsets: Mapping[str, float]
    """By sensor, the sensor's clock minus the root's in the middle of the recording, without jumps, s."""
    T_world_root: Array
    """(4, 4) to the frame of the hall: z up, the floor at z = 0 in its middle."""
    mounts: tuple[HallMount, ...]
    hall: Hall


@dataclass(frozen=True, eq=False)
class SimulatedHall:
    """A recording with its ground truth."""

    scenario: HallScenario
    ranges: Mapping[str, NDArray[np.float32]]
    """(K, G * B) by sensor, m; NaN without a return."""
    stamps: Mapping[str, Array]
    """(K,) of sweeps by sensor, s."""
    truth: HallTruth

    @property
    def rig(self) -> Rig:
        """As a user would write it, without any pose."""
        sensors: dict[str, Any] = {
            mount.sensor.name: {
                "kind": "lidar2d" if mount.sensor.kind == "scanner" else "lidar3d",
                "topic": topic_of(mount.sensor),
                "frame_id": mount.sensor.name,
            }
            for mount in self.truth.mounts
        }
        return Rig.model_validate({"root": self.truth.root, "target": {"kind": "people"}, "sensors": sensors})

    @cached_property
    def recording(self) -> IndexedRecording:
        """All messages, which are made of the ranges when they are read; they arrive by the root's clock."""
        rng = np.random.default_rng((self.scenario.seed, 50))
        records, types = [], {}
        for mount in self.truth.mounts:
            name, topic = mount.sensor.name, topic_of(mount.sensor)
            types[topic] = "scan" if mount.sensor.kind == "scanner" else "cloud"
            delay = float(mount.columns.times[-1]) - self.truth.clock_offsets[name]
            beams = None if mount.sensor.kind == "scanner" else mount.columns.directions.reshape(-1, 3)
            for stamp, ranges in zip(self.stamps[name].tolist(), self.ranges[name], strict=True):
                decode = partial(_read_message, stamp, name, mount.columns, beams, ranges)
                arrival = stamp + delay + rng.uniform(*_LATENCIES)
                records.append(RecordedMessage(topic, stamp, arrival, decode))
        return IndexedRecording(Path("messages"), records, types)


def _read_message(
    stamp: float, name: str, columns: Columns, beams: Array | None, ranges: NDArray[np.float32]
) -> LaserScan | PointCloud:
    measured = ranges.astype(np.float64)
    if beams is None:
        increment = float(columns.times[-1]) / (len(columns.times) - 1)
        return LaserScan(stamp, name, columns.azimuths, measured, increment)
    kept = np.flatnonzero(np.isfinite(measured))
    column, ring = np.divmod(kept, columns.elevations.shape[1])
    points = measured[kept, None] * beams[kept]
    return PointCloud(stamp, name, points, ring.astype(np.int32), columns.times[column])


def topic_of(sensor: DriveSensor) -> str:
    """The topic of a sensor's messages."""
    return f"/{sensor.name}/{'scan' if sensor.kind == 'scanner' else 'points'}"


def simulate_hall(scenario: HallScenario) -> SimulatedHall:
    """Simulates a recording.

    Raises:
        InputError: there are too many people for the hall, or no place for a sensor.
    """
    hall = build_hall(scenario)
    mount_rng = np.random.default_rng((scenario.seed, 10))
    mounts = _mount_sensors(scenario, hall, mount_rng)
    ranges, stamps = {}, {}
    for index, mount in enumerate(mounts):
        rng = np.random.default_rng((scenario.seed, 100 + index))
        ranges[mount.sensor.name], stamps[mount.sensor.name] = _simulate_sensor(scenario, hall, mount, rng)
    return SimulatedHall(scenario, ranges, stamps, _describe_truth(hall, mounts))


def _describe_truth(hall: Hall, mounts: tuple[HallMount, ...]) -> HallTruth:
    last = [mount.poses[len(mount.poses) // 2 if mount.swing_period else -1] for mount in mounts]
    names = [mount.sensor.name for mount in mounts]
    T_root_world = se3.inverse(last[0])
    return HallTruth(
        names[0],
        {name: T_root_world @ T for name, T in zip(names, last, strict=True)},
        {mount.sensor.name: mount.clock.offset - mounts[0].clock.offset for mount in mounts},
        last[0],
        mounts,
        hall,
    )


def _simulate_sensor(
    scenario: HallScenario, hall: Hall, mount: HallMount, rng: np.random.Generator
) -> tuple[NDArray[np.float32], Array]:
    """Ranges (K, G * B) and stamps (K,) of a sensor."""
    faults, sensor, clock = scenario.faults, mount.sensor, mount.clock
    errors = replace(
        scenario.errors,
        noise=rng.uniform(*scenario.noise) if scenario.errors.noise else 0.0,
        ring_bias=faults.ring_bias or scenario.errors.ring_bias,
    )
    own = draw_scanner_errors(errors, sensor.rings, rng)
    starts = np.arange(clock.phase, scenario.duration - clock.period, clock.period)
    ranges = simulate_sweeps(
        hall, sensor, mount.columns, mount.poses, mount.pose_of(starts), starts, errors, own, rng
    )
    if sensor.name == scenario.faulty and faults.range_scale:
        ranges *= np.float32(1 + faults.range_scale)
    if faults.false_returns:
        _add_false_returns(ranges, faults.false_returns, rng)
    stamps = scenario.start_time + clock.stamps(starts) + rng.normal(0, _STAMP_JITTER, len(starts))
    sent = np.flatnonzero(rng.random(len(starts)) >= _LOST_MESSAGES)
    return ranges[sent], stamps[sent]


def _add_false_returns(ranges: NDArray[np.float32], share: float, rng: np.random.Generator) -> None:
    """Drops return some beams before what they would hit, near ones more often, in place."""
    for row in ranges:
        rays = rng.choice(len(row), rng.poisson(share * len(row)))
        row[rays] = np.minimum(np.nan_to_num(row[rays], nan=20.0), 0.5 + 15.0 * rng.random(len(rays)) ** 2)


def _draw_clock(scenario: HallScenario, sensor: DriveSensor, root: bool, rng: np.random.Generator) -> DriveClock:
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


def _draw_columns(sensor: DriveSensor, period: float, rng: np.random.Generator) -> Columns:
    """The pattern of a sweep: columns from right to left, or from left to right."""
    width = np.radians(sensor.sector)
    count = round(sensor.sector / sensor.step) + 1
    angles = (np.arange(count) / (count - 1) - 0.5) * width
    share = _TURN_TIME if sensor.kind == "solid_state" else sensor.sector / 360
    spin, begin = rng.choice([-1.0, 1.0]), rng.uniform(-np.pi, np.pi) * (sensor.kind == "lidar")
    ring = np.linspace(-1, 1, sensor.rings) if sensor.rings > 1 else np.zeros(1)
    spin = 1.0 if sensor.kind == "scanner" else spin
    return Columns(
        np.arange(count) / (count - 1) * share * period,
        (begin + spin * angles + np.pi) % (2 * np.pi) - np.pi,
        np.tile(np.radians(sensor.elevation) * ring, (count, 1)),
    )


def _mount_sensors(scenario: HallScenario, hall: Hall, rng: np.random.Generator) -> tuple[HallMount, ...]:
    mounts = []
    turn = rng.uniform()
    for index, sensor in enumerate(scenario.sensors):
        clock = _draw_clock(scenario, sensor, index == 0, rng)
        columns = _draw_columns(sensor, clock.period, rng)
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
    """T_world_sensor of a level scanner, but for a degree."""
    yaw = np.arctan2(-place[1], -place[0]) + rng.normal(0, 0.2)
    tilt = np.radians(np.clip(rng.normal(0, 0.4, 2), -1, 1))
    R = so3.exp(np.array([0, 0, yaw])) @ so3.exp(np.array([*tilt, 0.0]))
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
    solids = [Solid(one.shape, one.T_world_shape) for one in hall.surfaces if not one.glass]
    hits = cast_rays(solids, T_world_sensor[None, :3, 3], away / distance[:, None])
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

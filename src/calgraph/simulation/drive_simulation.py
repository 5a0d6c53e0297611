"""Simulation of a robot that drives: the messages of its sensors, and the ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid

from calgraph.geometry import Array, se3, so3
from calgraph.recording.record_list import MessageRecording
from calgraph.sensors import LaserScan, Message, PointCloud, Pose, TurnRate
from calgraph.simulation.drive_beams import draw_scanner_errors, measure, sweep_columns
from calgraph.simulation.drive_boards import DriveCamera, SimulatedBoards, board_surface, draw_camera, hang_boards
from calgraph.simulation.drive_motion import (
    INTERVAL,
    MARGIN,
    Motion,
    Route,
    carry_motion,
    draw_drift,
    draw_motion,
    draw_route,
)
from calgraph.simulation.drive_robot import DriveMount, draw_robot_size, mount_sensors
from calgraph.simulation.drive_scenario import RANGING, DriveScenario, DriveSensor, DriveSensorKind
from calgraph.simulation.drive_world import LAYOUTS, DriveWorld, build_world, draw_bodies

_BLOCK_COLUMNS = 3000
"""Columns cast together: bounds memory, and keeps arrays in the processor's cache."""
_TOPICS: Mapping[DriveSensorKind, str] = {
    "lidar": "points", "solid_state": "points", "scanner": "scan", "odometry": "odometry",
    "trajectory": "odometry", "gyroscope": "imu", "camera": "image_raw/compressed",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class DriveTruth:
    """The ground truth of a drive. Stamps are of the root's clock."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor, until the fault."""
    T_root_sensor_after: Mapping[str, Array]
    """(4, 4) by sensor, from then on: others if a sensor was bumped."""
    clock_offsets: Mapping[str, float]
    """By sensor, the sensor's clock minus the root's in the middle of the drive, without jumps, s."""
    T_base_root: Array
    """(4, 4) to the frame on the ground below the middle of the rear axle, x ahead, z up."""
    times: Array
    """(K,) stamps of the trajectory, 100 per second, s."""
    T_world_root: Array
    """(K, 4, 4) trajectory of the root."""
    mounts: tuple[DriveMount, ...]
    motion: Motion
    """Of the base, at true times from the start of the recording."""
    world: DriveWorld
    boards: SimulatedBoards
    """Boards on walls, and cameras."""


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """A recording of a drive with its ground truth."""

    scenario: DriveScenario
    root: str
    messages: Mapping[str, Sequence[Message]]
    """Clouds with times and rings on ``/NAME/points``, scans on ``/NAME/scan``, poses of other programs on
    ``/NAME/odometry``, and rates of gyroscopes on ``/NAME/imu``."""
    truth: DriveTruth

    @property
    def topics(self) -> Mapping[str, str]:
        """Topic by sensor."""
        return {one.name: topic_of(one) for one in self.scenario.sensors}

    @cached_property
    def recording(self) -> MessageRecording:
        """All messages but images, as a recording.

        Raises:
            InputError: there are none.
        """
        return MessageRecording(self.messages)


def topic_of(sensor: DriveSensor) -> str:
    """The topic of a sensor's messages."""
    return f"/{sensor.name}/{_TOPICS[sensor.kind]}"


def simulate_drive(scenario: DriveScenario) -> SimulatedDrive:
    """Simulates a drive.

    Raises:
        InputError: the sensors' fields are too wide to share no view.
    """
    kind_rng, route_rng, world_rng, motion_rng, mount_rng, body_rng = (
        np.random.default_rng((scenario.seed, k)) for k in range(6)
    )
    kind = scenario.world or ("room", "hall", "yard")[int(kind_rng.integers(3))]
    size = draw_robot_size(mount_rng)
    mounts = mount_sensors(scenario, size, mount_rng)
    route = draw_route(scenario.path, LAYOUTS[kind].reach, scenario.duration, scenario.slip, route_rng)
    clearance = 0.3 + float(np.hypot(0.8 * size[0], size[1] / 2))
    uneven = scenario.path != "planar" and kind != "corridor"
    ramps = scenario.path in ("ordinary", "stops") and kind in ("room", "hall", "yard")
    world = build_world(kind, route, clearance, uneven, ramps, scenario.glass, world_rng)
    cars = scenario.cars if kind in ("hall", "yard") else 0
    bodies = draw_bodies(route, clearance, scenario.people, cars, scenario.faults.truck, body_rng)
    world = replace(world, bodies=bodies)
    bounce = 0.0 if scenario.path == "planar" else scenario.bounce
    if scenario.path == "carried":
        motion = carry_motion(route, motion_rng)
    else:
        motion = draw_motion(route, world.ground_height, (0.6 * size[0], 0.8 * size[1]), bounce, motion_rng)
    boards = _draw_boards(scenario, route, mounts, world)
    world = replace(world, boards=tuple(board_surface(one) for one in boards.boards))
    messages: dict[str, Sequence[Message]] = {}
    for index, mount in enumerate(mounts):
        rng = np.random.default_rng((scenario.seed, 100 + index))
        if mount.sensor.kind in RANGING:
            messages[topic_of(mount.sensor)] = _simulate_scanner(scenario, world, motion, mount, rng)
        elif mount.sensor.kind == "odometry":
            messages[topic_of(mount.sensor)] = _simulate_odometry(scenario, route, mount, rng)
        elif mount.sensor.kind == "trajectory":
            messages[topic_of(mount.sensor)] = _simulate_trajectory(scenario, motion, mount, rng)
        elif mount.sensor.kind == "gyroscope":
            messages[topic_of(mount.sensor)] = _simulate_gyroscope(scenario, motion, mount, rng)
    truth = _drive_truth(scenario, mounts, motion, world, boards)
    return SimulatedDrive(scenario, truth.root, messages, truth)


def _draw_boards(
    scenario: DriveScenario, route: Route, mounts: tuple[DriveMount, ...], world: DriveWorld
) -> SimulatedBoards:
    """Boards and cameras, of a robot with cameras."""
    rng = np.random.default_rng((scenario.seed, 6))
    cameras: dict[str, DriveCamera] = {
        mount.sensor.name: draw_camera(mount.sensor.sector, scenario.image_size, scenario.camera_errors, rng)
        for mount in mounts
        if mount.sensor.kind == "camera"
    }
    boards = hang_boards(scenario, route, world.surfaces, rng) if cameras else ()
    return SimulatedBoards(boards, cameras)


def _simulate_scanner(
    scenario: DriveScenario, world: DriveWorld, motion: Motion, mount: DriveMount, rng: np.random.Generator
) -> list[PointCloud] | list[LaserScan]:
    sensor, clock = mount.sensor, mount.clock
    own = draw_scanner_errors(scenario.errors, sensor.rings, rng)
    stretch = 1 + scenario.faults.range_scale * (sensor.name == scenario.faulty)
    starts = np.arange(clock.phase, scenario.duration - clock.period, clock.period)
    columns = sweep_columns(sensor, mount.centre, mount.spin, starts, clock.period)
    poses = mount.poses(motion, columns.times)
    per_sweep = len(columns.times) // len(starts)
    block = max(1, _BLOCK_COLUMNS // per_sweep) * per_sweep
    ranges = np.concatenate(
        [
            stretch
            * measure(world, poses[k : k + block], columns[k : k + block], sensor, scenario.errors, own, rng)
            for k in range(0, len(columns.times), block)
        ]
    )
    stamps = scenario.start_time + clock.stamps(columns.times)
    stamps += np.repeat(rng.normal(0, scenario.stamp_jitter, len(starts)), per_sweep)
    sent = np.flatnonzero(rng.random(len(starts)) >= scenario.lost_messages).tolist()
    parts = [slice(k * per_sweep, (k + 1) * per_sweep) for k in sent]
    if sensor.kind == "scanner":
        # Angles and times of a scan count from its first beam, in the direction of rotation.
        return [
            LaserScan(
                float(stamps[part.start]),
                sensor.name,
                columns.azimuths[part],
                ranges[part, 0],
                float(np.ptp(stamps[part])) / (per_sweep - 1),
            )
            for part in parts
        ]
    clouds, rings = [], np.arange(sensor.rings, dtype=np.int32)
    for part in parts:
        # All beams of a column state one time.
        kept = np.isfinite(ranges[part])
        stamp = stamps[part.stop - 1 if mount.stamps_end else part.start]
        points = (ranges[part, :, None] * columns[part].directions)[kept]
        times = np.broadcast_to((stamps[part] - stamp)[:, None], kept.shape)[kept]
        clouds.append(
            PointCloud(float(stamp), sensor.name, points, np.broadcast_to(rings, kept.shape)[kept], times)
        )
    return clouds


def _times_of(scenario: DriveScenario, mount: DriveMount) -> Array:
    """(N,) true times of the poses or rates of a sensor, s from the start of the recording."""
    return np.arange(mount.clock.phase, scenario.duration, mount.clock.period)


def _make_poses(scenario: DriveScenario, mount: DriveMount, times: Array, poses: Array) -> list[Pose]:
    """The messages of poses (N, 4, 4) at true times (N,), s."""
    stamps, quaternions = scenario.start_time + mount.clock.stamps(times), so3.quaternion(poses[:, :3, :3])
    return [
        Pose(stamp, mount.sensor.name, T[:3, 3], q)
        for stamp, T, q in zip(stamps.tolist(), poses, quaternions, strict=True)
    ]


def _simulate_odometry(
    scenario: DriveScenario, route: Route, mount: DriveMount, rng: np.random.Generator
) -> list[Pose]:
    """Wheel odometry: planar poses of the base from wheel speeds, which are wrong by scale, slip and noise."""
    count = len(route.times)
    # Wheels' radii are wrong by a per cent, and tyres slip by half of one, more when the robot accelerates.
    slip = 0.005 * draw_drift(count, 1.0, rng) + 0.01 * np.gradient(route.speeds, INTERVAL)
    speeds = route.speeds * (1 + rng.normal(0, 0.01) + slip) + 0.01 * rng.normal(size=count)
    turns = route.turn_rates * (1 + rng.normal(0, 0.015) + 0.01 * draw_drift(count, 1.0, rng))
    turns = turns + rng.normal(0, 0.001) + 0.01 * rng.normal(size=count) * (np.abs(route.speeds) > 0.01)
    yaws = cumulative_trapezoid(turns, dx=INTERVAL, initial=0)
    velocity = speeds[:, None] * np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)
    xy = cumulative_trapezoid(velocity, dx=INTERVAL, axis=0, initial=0)
    times = _times_of(scenario, mount)
    start = int(MARGIN / INTERVAL)
    x, y, yaw = (np.interp(times, route.times, v - v[start]) for v in (*xy.T, yaws))
    c, s = np.cos(yaws[start]), np.sin(yaws[start])
    place = np.stack([c * x + s * y, c * y - s * x, 0 * x], axis=-1)
    poses = se3.pose(so3.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])), place)
    return _make_poses(scenario, mount, times, poses)


def _simulate_trajectory(
    scenario: DriveScenario, motion: Motion, mount: DriveMount, rng: np.random.Generator
) -> list[Pose]:
    """The trajectory of another program: it drifts by 0.5 % of the way, and has noise."""
    times = _times_of(scenario, mount)
    true = mount.poses(motion, times)
    # Errors per step in the sensor's frame accumulate; noise of each pose does not.
    step = se3.inverse(true[:-1]) @ true[1:]
    moved = np.linalg.norm(step[:, :3, 3], axis=1)
    drifts = np.array(
        [np.interp(times[1:], motion.times, draw_drift(len(motion.times), 2.0, rng)) for _ in range(6)]
    )
    errors = drifts.T * np.repeat([0.005, 0.002], 3) * moved[:, None]
    poses = np.empty_like(true)
    poses[0] = se3.pose(so3.exp(rng.uniform(-np.pi, np.pi) * np.array([0.0, 0.0, 1.0])), rng.normal(0, 5, 3))
    wrong = se3.retract(step, errors)
    for k in range(len(step)):
        poses[k + 1] = poses[k] @ wrong[k]
    noise = rng.normal(size=(len(poses), 6)) * np.repeat([0.001, np.radians(0.01)], 3)
    return _make_poses(scenario, mount, times, se3.retract(poses, noise))


def _simulate_gyroscope(
    scenario: DriveScenario, motion: Motion, mount: DriveMount, rng: np.random.Generator
) -> list[TurnRate]:
    """Angular velocities with bias, slow drift of the bias, error of scale, and noise of a cheap sensor."""
    times = _times_of(scenario, mount)
    R = np.where((times > mount.clock.fault)[:, None, None], mount.T_base_sensor_after, mount.T_base_sensor)
    rates = np.einsum("nji,nj->ni", R[:, :3, :3], motion.rates(times)) * (1 + rng.normal(0, 0.003, 3))
    wander = np.stack(
        [np.interp(times, motion.times, draw_drift(len(motion.times), 10.0, rng)) for _ in range(3)], axis=-1
    )
    rates = rates + rng.normal(0, 0.005, 3) + 2e-4 * wander + 0.003 * rng.normal(size=rates.shape)
    stamps = scenario.start_time + mount.clock.stamps(times)
    return [TurnRate(stamp, mount.sensor.name, rate) for stamp, rate in zip(stamps.tolist(), rates, strict=True)]


def _drive_truth(
    scenario: DriveScenario,
    mounts: tuple[DriveMount, ...],
    motion: Motion,
    world: DriveWorld,
    boards: SimulatedBoards,
) -> DriveTruth:
    root = mounts[0]
    T_root_base, T_root_base_after = (se3.inverse(T) for T in (root.T_base_sensor, root.T_base_sensor_after))
    times = np.arange(0.0, scenario.duration, INTERVAL)
    return DriveTruth(
        root.sensor.name,
        {mount.sensor.name: T_root_base @ mount.T_base_sensor for mount in mounts},
        {mount.sensor.name: T_root_base_after @ mount.T_base_sensor_after for mount in mounts},
        {mount.sensor.name: mount.clock.offset - root.clock.offset for mount in mounts},
        root.T_base_sensor,
        scenario.start_time + root.clock.stamps(times),
        root.poses(motion, times),
        mounts,
        motion,
        world,
        boards,
    )

"""The simulated robot that drives: where its sensors are, what they cover, and their clocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.simulation.drive_beams import beam_directions
from calgraph.simulation.drive_motion import Motion
from calgraph.simulation.drive_scenario import RANGING, DriveScenario, DriveSensor

_DRAWS = 300
"""Of the pose of a sensor, until it shares no view with others."""
_GAP = np.radians(1.0)
"""Between fields that share no view, rad."""
_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of a camera that looks ahead: z ahead, x to the right, y down."""
_DISTANCES = (0.3, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""At which fields are compared, m."""


@dataclass(frozen=True)
class DriveClock:
    """A sensor's clock and the times of its measurements."""

    offset: float
    """Sensor's clock minus true time in the middle of the drive, without the jump, s."""
    drift: float
    """By how much it runs fast."""
    jump: float
    """By how much it is ahead from the fault on, s."""
    period: float
    """True time between measurements, s."""
    phase: float
    """Of the first measurement, s."""
    middle: float
    """Of the drive, s."""
    fault: float
    """Time of the fault, s."""

    def stamps(self, times: Array) -> Array:
        """The clock's reading (N,) at true times (N,), s from the start of the recording."""
        jumped = np.where(times > self.fault, self.jump, 0.0)
        return times + self.offset + jumped + self.drift * (times - self.middle)


@dataclass(frozen=True, eq=False)
class DriveMount:
    """A sensor on the robot."""

    sensor: DriveSensor
    T_base_sensor: Array
    """(4, 4) until the fault."""
    T_base_sensor_after: Array
    """(4, 4) from then on; another one if the sensor is bumped."""
    centre: float
    """Azimuth of the middle of its field in its frame, rad."""
    spin: float
    """+1 or -1: direction in which it turns."""
    stamps_end: bool
    """Whether messages have the time of their last point, as some drivers do."""
    clock: DriveClock

    def poses(self, motion: Motion, times: Array) -> Array:
        """(N, 4, 4) T_world_sensor at true times (N,), s from the start of the recording."""
        late = times > self.clock.fault
        T_base_sensor = np.where(late[:, None, None], self.T_base_sensor_after, self.T_base_sensor)
        return np.asarray(motion.poses(times) @ T_base_sensor)

    def covers(self, points: Array) -> NDArray[np.bool_]:
        """(N,) whether points (N, 3) of the base frame are in its field, or within a degree of it."""
        x, y, z = se3.apply(se3.inverse(self.T_base_sensor), points).T
        off = (np.arctan2(y, x) - self.centre + np.pi) % (2 * np.pi) - np.pi
        high = np.radians(self.sensor.elevation) + _GAP
        within = np.abs(off) < np.radians(self.sensor.sector) / 2 + _GAP
        return np.asarray(within & (np.abs(np.arctan2(z, np.hypot(x, y))) < high))

    def field(self) -> Array:
        """(N, 3) points of its field in the base frame, m."""
        half, high = np.radians(self.sensor.sector) / 2, np.radians(self.sensor.elevation)
        azimuths = self.centre + np.linspace(-half, half, 41)
        local = beam_directions(azimuths[:, None], np.linspace(-high, high, 7)).reshape(-1, 3)
        return se3.apply(self.T_base_sensor, np.concatenate([r * local for r in _DISTANCES]))


def draw_robot_size(rng: np.random.Generator) -> Array:
    """(3,) length, width and height of a robot, m."""
    length = rng.uniform(0.5, 2.0)
    return np.array([length, length * rng.uniform(0.5, 0.8), rng.uniform(0.4, 1.4)])


def mount_sensors(scenario: DriveScenario, size: Array, rng: np.random.Generator) -> tuple[DriveMount, ...]:
    """Draws poses and clocks of all sensors.

    Raises:
        InputError: the sensors' fields are too wide to share no view.
    """
    mounts: list[DriveMount] = []
    for index, sensor in enumerate(scenario.sensors):
        clock = _draw_clock(scenario, sensor, index == 0, rng)
        for _ in range(_DRAWS):
            mount = _draw_mount(scenario, sensor, size, clock, rng)
            if not (scenario.no_shared_view and _shares_view(mount, mounts)):
                break
        else:
            raise InputError(f"{sensor.name}: its field overlaps those of other sensors; take narrower sectors")
        mounts.append(mount)
    return tuple(mounts)


def _draw_mount(
    scenario: DriveScenario, sensor: DriveSensor, size: Array, clock: DriveClock, rng: np.random.Generator
) -> DriveMount:
    bearing = np.radians(sensor.bearing)
    toward = np.array([np.cos(bearing), np.sin(bearing)])
    # Anywhere on its side of the robot, whose middle is ahead of the rear axle.
    half = size[:2] / 2
    edge = 1 / max(float(np.max(np.abs(toward) / half)), 1e-9)
    place = np.array([0.3 * size[0], 0.0]) + rng.uniform(0.4, 1.0) * edge * toward
    place = place + rng.uniform(-0.3, 0.3) * half * np.array([-toward[1], toward[0]])
    place = np.append(place, rng.uniform(0.2, 0.2 + size[2]))
    centre = rng.uniform(-np.pi, np.pi)
    direction, angle = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(0, sensor.max_tilt))
    tilt = angle * np.array([np.cos(direction), np.sin(direction), 0.0])
    R = so3.exp(tilt) @ so3.exp(np.array([0.0, 0.0, bearing - centre]))
    if sensor.kind == "camera":
        R = so3.exp(tilt) @ so3.exp(np.array([0.0, 0.0, bearing])) @ _OPTICAL
    if sensor.kind in ("trajectory", "gyroscope"):
        R = so3.exp(rng.uniform(-1, 1, 3) * np.pi / 2)
    T = se3.pose(R, place)
    if sensor.kind == "odometry":
        T, centre = np.eye(4), 0.0
    after, bump = T, scenario.faults.bump
    if sensor.name == scenario.faulty and any(bump):
        shift, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        after = se3.pose(so3.exp(np.radians(bump[1]) * turn) @ R, place + bump[0] * shift)
    # Mirrors of 2-D scanners turn counter-clockwise.
    spin, stamps_end = float(rng.choice([-1.0, 1.0])), bool(rng.random() < 0.3)
    spin = 1.0 if sensor.kind == "scanner" else spin
    return DriveMount(sensor, T, after, centre, spin, stamps_end, clock)


def _draw_clock(
    scenario: DriveScenario, sensor: DriveSensor, is_root: bool, rng: np.random.Generator
) -> DriveClock:
    faults, faulty = scenario.faults, sensor.name == scenario.faulty
    offset = rng.uniform(-1, 1) * scenario.max_clock_offset
    # Motors and crystals of sensors differ by some per mille.
    period = 1 / (sensor.rate * (1 + rng.normal(0, 0.003)))
    return DriveClock(
        0.0 if is_root else offset,
        # Quartz: some parts in a million.
        0.0 if is_root else rng.normal(0, 5e-6) + faulty * faults.clock_drift,
        faulty * faults.clock_jump,
        period,
        rng.uniform(0, period),
        scenario.duration / 2,
        scenario.duration * faults.time,
    )


def _shares_view(mount: DriveMount, others: Sequence[DriveMount]) -> bool:
    if mount.sensor.kind not in RANGING:
        return False
    return any(
        bool(other.covers(mount.field()).any() or mount.covers(other.field()).any())
        for other in others
        if other.sensor.kind in RANGING
    )

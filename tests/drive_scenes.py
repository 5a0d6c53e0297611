"""Rooms of boxes, in the plane or in space, that moving range sensors measure; their poses are known."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calgraph.drive.sweeps import Sweep
from calgraph.geometry import Array, se_n
from calgraph.sensors import LaserScan, Message
from calgraph.surfaces.sensor_states import TIMING

PERIOD = 0.1
"""Of sweeps, s."""


@dataclass(frozen=True, eq=False)
class Room:
    """A box from within, and boxes in it from outside, with edges along the axes."""

    walls: Array
    """(2, n) lower and upper corner, m."""
    boxes: Array
    """(B, 2, n) m."""

    def measure(self, origins: Array, directions: Array) -> Array:
        """(N,) ranges of rays (N, n), m."""
        with np.errstate(divide="ignore"):
            inverse = 1 / directions
        ranges = np.max((self.walls[:, None] - origins) * inverse, axis=0).min(axis=1)
        for box in self.boxes:
            both = (box[:, None] - origins) * inverse
            near, far = both.min(axis=0).max(axis=1), both.max(axis=0).min(axis=1)
            ranges = np.where((near < far) & (near > 0) & (near < ranges), near, ranges)
        return np.asarray(ranges)


FLAT = Room(
    np.array([[-5.0, -4.0], [6.0, 4.5]]),
    np.array([[[3.5, -3.0], [4.5, -2.2]], [[-3.9, 2.6], [-3.1, 3.4]], [[-0.5, 3.4], [1.0, 4.5]]]),
)
HIGH = Room(
    np.array([[-5.0, -4.0, -0.5], [6.0, 4.5, 3.0]]),
    np.array([
        [[3.5, -3.0, -0.5], [4.5, -2.2, 1.5]],
        [[-3.9, 2.6, -0.5], [-3.1, 3.4, 0.8]],
        [[-0.5, 3.4, -0.5], [1.0, 4.5, 2.0]],
    ]),
)  # fmt: skip
ROOMS = {2: FLAT, 3: HIGH}


def drive(times: Array, n: int) -> Array:
    """Poses (N, n+1, n+1) along an eight of 20 s, from rest; in space with small roll, pitch and height."""
    phase = 2 * np.pi / 20 * (times - 0.5 * (1 - np.exp(-2 * times)))
    place = np.stack([2.5 * np.sin(phase), 1.2 * np.sin(2 * phase)], axis=1)
    heading = np.unwrap(np.arctan2(2.4 * np.cos(2 * phase), 2.5 * np.cos(phase)))
    if n == 2:
        return se_n.pose(se_n.exp(heading[:, None]), place)
    turn = np.stack([0.05 * np.sin(5 * phase), 0.05 * np.cos(4 * phase), heading], axis=1)
    height = 0.8 + 0.1 * np.sin(3 * phase)
    return se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), np.column_stack([place, height]))


def beams_in_plane(step: float = 0.5) -> tuple[Array, Array]:
    """Directions (N, 2) over 270°, and times within a sweep (N,), s."""
    angle = np.radians(np.arange(-135, 135 + step / 2, step))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), PERIOD * (angle - angle[0]) / (2 * np.pi)


def beams_in_space(rings: int = 16, step: float = 2.0) -> tuple[Array, Array]:
    """Directions (N, 3) of rings over 30°, and times within a sweep (N,), s."""
    azimuth = np.repeat(np.radians(np.arange(-180, 180, step)), rings)
    elevation = np.tile(np.radians(np.linspace(-15, 15, rings)), len(azimuth) // rings)
    c = np.cos(elevation)
    directions = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)], axis=1)
    return directions, PERIOD * (azimuth + np.pi) / (2 * np.pi)


def scan(
    beams: tuple[Array, Array],
    T_root_sensor: Array,
    duration: float,
    noise: float,
    rng: np.random.Generator,
    path: Callable[[Array, int], Array] = drive,
) -> list[Sweep]:
    """Sweeps of a sensor during a drive through the room of its dimension, with white noise of ranges, m."""
    directions, within = beams
    n = directions.shape[1]
    sweeps = []
    for start in np.arange(0, duration - PERIOD / 2, PERIOD):
        T = path(start + within, n) @ T_root_sensor
        rays = (se_n.rotation(T) @ directions[:, :, None])[..., 0]
        ranges = ROOMS[n].measure(se_n.translation(T), rays) + rng.normal(0, noise, len(rays))
        times = start + within
        exact = np.zeros((len(times), TIMING))
        sweeps.append(Sweep(float(start + within[-1] / 2), directions * ranges[:, None], times, exact))
    return sweeps


def scan_drive(poses: Mapping[str, Array], duration: float) -> dict[str, list[Message]]:
    """By topic, scans of 2-D scanners with poses (4, 4) in the plane during a drive, s."""
    rng, beams = np.random.default_rng(0), beams_in_plane(1.0)
    angles = np.arctan2(beams[0][:, 1], beams[0][:, 0])
    increment = PERIOD * 0.75 / (len(angles) - 1)
    return {
        f"/{name}": [
            LaserScan(float(sweep.times[0]), name, angles, np.hypot(*sweep.points.T), increment)
            for sweep in scan(beams, T[np.ix_([0, 1, 3], [0, 1, 3])], duration, 0.01, rng)
        ]
        for name, T in poses.items()
    }

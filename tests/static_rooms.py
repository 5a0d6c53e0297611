"""Scans of a furnished room without people, from poses that change with time."""

from collections.abc import Callable

import numpy as np

from calgraph.geometry import Array, se2
from calgraph.sensors import LaserScan
from calgraph.simulation.network_beams import cast_segments
from calgraph.simulation.network_floor import polygon_sides, rectangle

ANGLES = np.radians(np.arange(-135, 135.1, 0.5))
ROOM = polygon_sides(np.array([(-2, -3), (6, -3), (6, 2), (3, 2), (3, 4), (-2, 4)], dtype=np.float64))
CORRIDOR = np.array([[(-50, -1), (50, -1)], [(-50, 1.5), (50, 1.5)]], dtype=np.float64)
DESK, CUPBOARD = rectangle((3.0, -1.0), (1.4, 0.7), 0.3), rectangle((0.5, 2.5), (1.0, 0.5), -0.2)
FURNITURE = np.concatenate([polygon_sides(DESK), polygon_sides(CUPBOARD)])

Motion = Callable[[float], Array]
"""The pose (3, 3) of the scanner at a time, s."""


def stay(_time: float) -> Array:
    return np.eye(3)


def step(at: float, x: float = 0.0, y: float = 0.0, degrees: float = 0.0) -> Motion:
    """A pose that changes at a time, s."""
    T = se2.pose(np.radians(degrees), np.array([x, y]))
    return lambda time: T if time >= at else np.eye(3)


def scan_room(
    seconds: float,
    motion: Motion = stay,
    segments: Callable[[float], Array] = lambda _time: np.concatenate([ROOM, FURNITURE]),
    noise: float = 0.01,
    rate: float = 10.0,
    max_range: float = 12.0,
) -> list[LaserScan]:
    """Scans with stamps from 0 s."""
    rng = np.random.default_rng(0)
    scans = []
    for stamp in np.arange(round(seconds * rate)) / rate:
        T = motion(float(stamp))
        ranges = cast_segments(T[:2, 2], float(se2.angle(T)) + ANGLES, segments(float(stamp)))
        ranges = ranges + rng.normal(0, noise, len(ANGLES))
        scans.append(LaserScan(float(stamp), "laser", ANGLES, np.where(ranges < max_range, ranges, np.inf), 0.0))
    return scans

"""Sweeps of LiDARs in the form that odometry and adjustment use: points with times, thinned."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, measure_lengths
from calgraph.sensors import LaserScan, PointCloud

# Nearer points are of the robot itself, and ranges of many scanners are not exact there, m.
MIN_RANGE = 0.5
# Farther surfaces are met by few beams, at footprints of decimetres, m.
MAX_RANGE = 80.0


@dataclass(frozen=True, eq=False)
class Sweep:
    """The points of one sweep, in the moving frame of the sensor at the time of each; n = 2 or 3."""

    time: float
    """In the middle of its points, s, by the sensor's clock."""
    points: Array
    """(N, n) m."""
    times: Array
    """(N,) s, by the sensor's clock."""

    def select(self, index: Index) -> "Sweep":
        """Some of the points."""
        return Sweep(self.time, self.points[index], self.times[index])


def read_sweep(message: LaserScan | PointCloud, dimension: int) -> Sweep:
    """The finite points of a message within the ranges that are used, in the plane (2) or in space (3)."""
    if isinstance(message, LaserScan):
        points = message.points
        times = message.stamp + message.time_increment * np.arange(len(points), dtype=np.float64)
    else:
        points = message.points
        times = np.full(len(points), message.stamp) if message.times is None else message.stamp + message.times
    finite = np.isfinite(points).all(axis=1)
    points, times = points[finite], times[finite]
    ranges = measure_lengths(points)
    used = (ranges >= MIN_RANGE) & (ranges <= MAX_RANGE)
    points, times = points[used, :dimension].astype(np.float64), times[used]
    middle = (times.min() + times.max()) / 2 if len(times) else message.stamp
    return Sweep(float(middle), points, times)


def thin_sweep(sweep: Sweep, count: int, rng: np.random.Generator) -> Sweep:
    """The sweep with at most ``count`` points, drawn at random."""
    if len(sweep.points) <= count:
        return sweep
    return sweep.select(np.sort(rng.choice(len(sweep.points), count, replace=False)))

"""Sweeps of LiDARs in the form that odometry and adjustment use: points with times, thinned."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, Index, measure_lengths
from calgraph.sensors import LaserScan, PointCloud
from calgraph.sensors.stamp_smoothing import smooth_stamps
from calgraph.surfaces.sensor_states import TIMING

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
    timing: Array
    """(N, 3) as of :attr:`SensorPoints.timing`, of beams whose times are not stated; 0 otherwise."""

    @property
    def flat(self) -> "Sweep":
        """The same in the plane."""
        return replace(self, points=self.points[:, :2])

    def select(self, index: Index) -> "Sweep":
        """Some of the points."""
        return Sweep(self.time, self.points[index], self.times[index], self.timing[index])


def read_sweep(message: LaserScan | PointCloud, dimension: int) -> Sweep:
    """The finite points of a message within the ranges that are used, in the plane (2) or in space (3).

    Timing is in units of the sweep and of the delay of odd beams.
    """
    points = message.points
    timing = np.zeros((len(points), TIMING))
    if isinstance(message, LaserScan):
        beam = np.arange(len(points), dtype=np.float64)
        times = message.stamp + message.time_increment * beam
        if message.time_increment == 0:
            timing[:, 0], timing[:, 1] = beam / max(len(points) - 1, 1), beam % 2
    else:
        times = np.full(len(points), message.stamp) if message.times is None else message.stamp + message.times
    finite = np.isfinite(points).all(axis=1)
    points, times, timing = points[finite], times[finite], timing[finite]
    ranges = measure_lengths(points)
    used = (ranges >= MIN_RANGE) & (ranges <= MAX_RANGE)
    points, times, timing = points[used, :dimension].astype(np.float64), times[used], timing[used]
    middle = (times.min() + times.max()) / 2 if len(times) else message.stamp
    return Sweep(float(middle), points, times, timing)


def thin_sweep(sweep: Sweep, count: int, rng: np.random.Generator) -> Sweep:
    """The sweep with at most ``count`` points, drawn at random."""
    if len(sweep.points) <= count:
        return sweep
    return sweep.select(np.sort(rng.choice(len(sweep.points), count, replace=False)))


def join_sweeps(sweeps: Sequence[Sweep]) -> Sweep:
    """The points of one sweep or more as one, without a common time."""
    points, times, timing = (
        np.concatenate([getattr(one, name) for one in sweeps]) for name in ("points", "times", "timing")
    )
    return Sweep(np.nan, points, times, timing)


def smooth_times(sweeps: Sequence[Sweep], stamps: Array) -> list[Sweep]:
    """Sweeps by the smoothed stamps (M,) of their messages, s, ascending; timing is in seconds then."""
    period, smooth = smooth_stamps(stamps)
    units = np.array([period, period, 1.0])
    return [
        replace(
            one,
            time=one.time + float(shift),
            times=one.times + shift,
            timing=one.timing * units - shift * np.eye(TIMING)[-1],
        )
        for one, shift in zip(sweeps, smooth - stamps, strict=True)
    ]

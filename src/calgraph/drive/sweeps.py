"""Sweeps of LiDARs in the form that odometry and adjustment use: points with times, thinned."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.drive.states import TIMING
from calgraph.geometry import STDDEV_PER_MAD, Array, Index, measure_lengths
from calgraph.sensors import LaserScan, PointCloud

# Nearer points are of the robot itself, and ranges of many scanners are not exact there, m.
MIN_RANGE = 0.5
# Farther surfaces are met by few beams, at footprints of decimetres, m.
MAX_RANGE = 80.0
# Sweeps before and after one through whose stamps a line is fitted: over some seconds, periods of motors stay the
# same, and stamps that are rounded to 10 ms have an error of 0.4 ms. Fewer sweeps than these determine no line.
_LINE, _MIN_LINE = 30, 5
# By how much a step differs from a multiple of the period, as a share of it, where a clock jumped.
_MAX_IRREGULARITY = 0.25
# Until the weights of stamps that are late stay the same.
_REWEIGHTINGS = 4


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


def smooth_stamps(stamps: Array) -> tuple[float, Array]:
    """The period of stamps, s, and what they would be (M,) of a sensor whose period varies slowly.

    Each is that of a line through its neighbours over the number of the sweep, by iteratively reweighted least
    squares. Where steps are no multiples of the period, clocks jump or sweeps are triggered: no line crosses them.
    """
    if len(stamps) < _MIN_LINE:
        return 0.0, stamps
    steps = np.diff(stamps)
    period = float(np.median(steps))
    count = np.maximum(np.rint(steps / period), 1)
    broken = (np.abs(steps - count * period) > _MAX_IRREGULARITY * period) | (count > _LINE)
    number = np.concatenate([[0.0], np.cumsum(count)])
    run = np.concatenate([[0], np.cumsum(broken)])
    near = np.arange(len(stamps))[:, None] + np.arange(-_LINE, _LINE + 1)
    inside = np.clip(near, 0, len(stamps) - 1)
    weight = ((near == inside) & (run[inside] == run[:, None])).astype(np.float64)
    used = weight.sum(axis=1) >= _MIN_LINE
    near, inside, weight = near[used], inside[used], weight[used]
    x, y = number[inside] - number[used][:, None], stamps[inside] - stamps[used][:, None]
    robust = weight
    for _ in range(_REWEIGHTINGS):
        s, sx, sxx, sy, sxy = (np.sum(robust * one, axis=1) for one in (np.ones_like(x), x, x**2, y, x * y))
        slope = (s * sxy - sx * sy) / (s * sxx - sx**2)
        level = (sy - slope * sx) / s
        r = y - level[:, None] - slope[:, None] * x
        scale = 3 * STDDEV_PER_MAD * np.median(np.abs(r[weight > 0])) + 1e-6
        robust = weight / (1 + (r / scale) ** 2) ** 2
    smooth = stamps.copy()
    smooth[used] += level
    # Rounded steps have another median than mean.
    return (float(steps[~broken].sum() / count[~broken].sum()) if used.any() else period), smooth

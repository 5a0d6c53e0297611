"""LiDARs in a drive: sweeps, their odometry, and points on surfaces."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calgraph.config import Rig
from calgraph.drive.odometry import track_sensor
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import CLOCK_STDDEV, POSE_STDDEV, Source, SourceKind
from calgraph.drive.sweeps import Sweep, join_sweeps, read_sweep, smooth_times, thin_sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.sensors import LaserScan, Message, PointCloud
from calgraph.sensors.kinds import SensorSpec
from calgraph.sensors.kinds.stated import RangeUncertainty
from calgraph.surfaces.sensor_states import SensorPoints
from calgraph.surfaces.trajectory import Track

# Points of a sweep that are kept, registered in odometry, and adjusted: cells of 1 m within 10 m have some ten of
# 4000, and bodies of a room are met by ten of 150.
_KEPT_POINTS, _TRACKED_POINTS, _ADJUSTED_POINTS = 4000, 600, 150
# Sweeps below which there is no motion to compare: three relative motions of 1.5 s at 10 Hz.
_MIN_SWEEPS = 50
# Largest standard deviation that the points of a sweep in space leave its position, m, for odometry to count, and
# the least share of such sweeps: of 49 simulated sensors, eight have less, and at most half of the motions of each
# are right; all others have 0.69 and more.
_MAX_STDDEV, _MIN_DETERMINED = 0.05, 0.5
# Of the sweep and of the delay of odd beams, in periods: beams are measured within one, in either direction. Of
# the share of stamps' irregularity that is real: none is, of an operating system's, or all, of a trigger's.
_TIMING_STDDEV = (0.5, 0.5, 1.0)


class LidarReader:
    """Keeps the sweeps of a LiDAR, thinned."""

    def __init__(self, rig: Rig, name: str, dimension: int, rng: np.random.Generator) -> None:
        self._flat, self._dimension, self._rng = rig.sensors[name].kind == "lidar2d", dimension, rng
        self._stamps: list[float] = []
        self._sweeps: list[Sweep] = []

    def add(self, message: Message) -> None:
        """See :class:`Reader`."""
        if isinstance(message, LaserScan | PointCloud):
            sweep = thin_sweep(read_sweep(message, self._dimension), _KEPT_POINTS, self._rng)
            if len(sweep.points):
                self._stamps.append(message.stamp)
                self._sweeps.append(sweep)

    def finish(self) -> "LidarSource":
        """Sweeps in order, without those of equal stamps: some drivers send messages twice."""
        stamps, kept = np.unique(self._stamps, return_index=True)
        sweeps = smooth_times([self._sweeps[k] for k in kept], stamps)
        return LidarSource(sweeps, self._dimension, self._flat and self._dimension == 3)


@dataclass(frozen=True, eq=False)
class LidarSource(Source):
    """The sweeps of a LiDAR."""

    sweeps: Sequence[Sweep]
    """By ascending time."""
    dimension: int
    flat_in_space: bool
    """Whether it is a 2-D scanner of a rig that moves in space."""

    @property
    def gap(self) -> float:
        """See :class:`Source`."""
        return float(np.median([b.times.min() - a.times.max() for a, b in pairwise(self.sweeps)]))

    def track(self, rng: np.random.Generator) -> Segments | Rejected:
        """The trajectory by odometry."""
        if len(self.sweeps) < _MIN_SWEEPS:
            return Rejected(f"it has {len(self.sweeps)} sweeps with points; a drive needs {_MIN_SWEEPS}")
        if self.flat_in_space:
            track = track_sensor([sweep.flat for sweep in self.sweeps], _TRACKED_POINTS, rng)
            return Segments((Track(track.times, se2.to_se3(track.poses)),))
        track = track_sensor(self.sweeps, _TRACKED_POINTS, rng)
        determined = float(np.mean(track.stddev < _MAX_STDDEV))
        if self.dimension == 3 and determined < _MIN_DETERMINED:
            return Rejected(
                f"the surfaces it measured show its motion in {determined:.0%} of its sweeps only: they are "
                "floor, or walls of one direction; raise or tilt it, or drive where walls and furniture are near"
            )
        return Segments((track,))

    def thin(self, rng: np.random.Generator) -> "LidarSource":
        """See :class:`Source`."""
        thinned = [thin_sweep(sweep, _ADJUSTED_POINTS, rng) for sweep in self.sweeps]
        return LidarSource(thinned, self.dimension, self.flat_in_space)

    def points(self, start: float, end: float) -> SensorPoints:
        """See :class:`Source`."""
        near = [sweep for sweep in self.sweeps if start - 1.0 <= sweep.time <= end + 1.0]
        if not near:
            return super().points(start, end)
        joined = join_sweeps(near)
        return SensorPoints(joined.points, joined.times, joined.timing, self.flat_in_space)


def _range_stddev(spec: SensorSpec, n: int) -> Array:
    """See :class:`SourceKind`."""
    stated = spec.uncertainty
    assert isinstance(stated, RangeUncertainty)
    ranges = stated.range_bias, stated.range_scale
    return np.array([*[POSE_STDDEV] * (n + n * (n - 1) // 2), CLOCK_STDDEV, *ranges, *_TIMING_STDDEV])


LIDAR_SOURCE = SourceKind(LidarReader, _range_stddev, has_surfaces=True)

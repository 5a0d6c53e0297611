"""LiDARs in a drive: sweeps, their odometry, and points on surfaces."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calgraph.config import Rig
from calgraph.drive.odometry import track_sensor
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import CLOCK_STDDEV, POSE_STDDEV, Source, SourceKind
from calgraph.drive.states import SensorPoints
from calgraph.drive.sweeps import Sweep, read_sweep, thin_sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.recording import Recording
from calgraph.sensors import LaserScan, Message, PointCloud
from calgraph.sensors.kinds import SensorSpec
from calgraph.sensors.kinds.stated import RangeUncertainty

# Points of a sweep that are kept, registered in odometry, and adjusted: cells of 1 m within 10 m have some ten of
# 4000, and bodies of a room are met by ten of 150.
_KEPT_POINTS, _TRACKED_POINTS, _ADJUSTED_POINTS = 4000, 600, 150
# Sweeps below which there is no motion to compare: three relative motions of 1.5 s at 10 Hz.
_MIN_SWEEPS = 50


class LidarReader:
    """Keeps the sweeps of a LiDAR, thinned."""

    def __init__(self, rig: Rig, name: str, _: Recording, dimension: int, rng: np.random.Generator) -> None:
        self._flat, self._dimension, self._rng = rig.sensors[name].kind == "lidar2d", dimension, rng
        self._sweeps: list[Sweep] = []

    def add(self, message: Message) -> None:
        """See :class:`Reader`."""
        if isinstance(message, LaserScan | PointCloud):
            sweep = thin_sweep(read_sweep(message, self._dimension), _KEPT_POINTS, self._rng)
            if len(sweep.points):
                self._sweeps.append(sweep)

    def finish(self) -> "LidarSource":
        """Sweeps by their times, without those of equal times: some drivers send messages twice."""
        ordered = sorted(self._sweeps, key=lambda sweep: sweep.time)
        kept = [sweep for k, sweep in enumerate(ordered) if k == 0 or sweep.time > ordered[k - 1].time]
        return LidarSource(kept, self._dimension, self._flat and self._dimension == 3)


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
        if self.flat_in_space:
            return Rejected("a 2-D scanner is calibrated in a drive with other 2-D scanners only")
        if len(self.sweeps) < _MIN_SWEEPS:
            return Rejected(f"it has {len(self.sweeps)} sweeps with points; a drive needs {_MIN_SWEEPS}")
        return Segments((track_sensor(self.sweeps, _TRACKED_POINTS, rng),))

    def thin(self, rng: np.random.Generator) -> "LidarSource":
        """See :class:`Source`."""
        thinned = [thin_sweep(sweep, _ADJUSTED_POINTS, rng) for sweep in self.sweeps]
        return LidarSource(thinned, self.dimension, self.flat_in_space)

    def points(self, start: float, end: float) -> SensorPoints:
        """See :class:`Source`."""
        near = [sweep for sweep in self.sweeps if start - 1.0 <= sweep.time <= end + 1.0]
        if not near:
            return super().points(start, end)
        return SensorPoints(
            np.concatenate([one.points for one in near]), np.concatenate([one.times for one in near])
        )


def _range_stddev(spec: SensorSpec, n: int) -> Array:
    """See :class:`SourceKind`."""
    stated = spec.uncertainty
    assert isinstance(stated, RangeUncertainty)
    return np.array([*[POSE_STDDEV] * (n + n * (n - 1) // 2), CLOCK_STDDEV, stated.range_bias, stated.range_scale])


LIDAR_SOURCE = SourceKind(LidarReader, _range_stddev, has_surfaces=True)

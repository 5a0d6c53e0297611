"""Gyroscopes in a drive: turn rates, integrated over short intervals."""

import numpy as np

from calgraph.config import Rig
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import SourceKind, without_ranges
from calgraph.drive.sources.trajectory import MotionSource, split_track
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n, so3
from calgraph.sensors import Message, TurnRate
from calgraph.sensors.kinds import SensorSpec
from calgraph.surfaces.trajectory import Track

# Rates below which there is no motion to compare: at 20 Hz, those of 10 s.
_MIN_RATES = 200
# Time without a rate after which another segment begins, s: turns change within it.
_MAX_GAP = 0.15
# Segments that are shorter are not used, s: ten motions.
_MIN_SEGMENT = 1.0


class GyroscopeReader:
    """Keeps turn rates."""

    def __init__(self, _: Rig, __: str, dimension: int, ___: np.random.Generator) -> None:
        self._dimension = dimension
        self._rates: list[tuple[float, ...]] = []

    def add(self, message: Message) -> None:
        """See :class:`Reader`."""
        if isinstance(message, TurnRate):
            self._rates.append((message.stamp, *message.rate))

    def finish(self) -> MotionSource:
        """The integral of finite rates in order of time, the first of each stamp."""
        rows = np.array(self._rates, dtype=np.float64).reshape(-1, 4)
        rows = rows[np.isfinite(rows).all(axis=1)]
        _, first = np.unique(rows[:, 0], return_index=True)
        return MotionSource(self._split(rows[first, 0], rows[first, 1:]), self._dimension, np.arange(3, 6))

    def _split(self, times: Array, rates: Array) -> Segments | Rejected:
        """Rotations by rates (N, 3) in segments, which end at gaps."""
        if self._dimension == 2:
            return Rejected("motion in the plane of 2-D scanners does not determine the rotation of a gyroscope")
        if len(times) < _MIN_RATES:
            return Rejected(f"it has {len(times)} usable turn rates; a drive needs {_MIN_RATES}")
        segments = split_track(_integrate(times, rates), np.diff(times) > _MAX_GAP, _MIN_SEGMENT)
        return segments or Rejected("its rates have gaps: none is longer than a second")


def _integrate(times: Array, rates: Array) -> Track:
    """Rotations at the times of rates, which are linear in between."""
    turns = so3.exp((rates[:-1] + rates[1:]) / 2 * np.diff(times)[:, None])
    R = np.empty((len(times), 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(turns):
        R[k + 1] = R[k] @ turn
    return Track(times, se_n.pose(R, np.zeros((len(times), 3))))


def _stddev(spec: SensorSpec, n: int) -> Array:
    """See :class:`SourceKind`: it has no place."""
    stddev = without_ranges(spec, n)
    stddev[:n] = 0.0
    return stddev


GYROSCOPE_SOURCE = SourceKind(GyroscopeReader, _stddev, has_place=False)

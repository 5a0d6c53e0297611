"""Gyroscopes in a drive: turn rates, integrated over short intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Rig
from calgraph.drive.measurements import Measurements
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import SourceKind, no_points, without_ranges
from calgraph.drive.sources.trajectory import STEP, average_poses, measure_motions
from calgraph.drive.states import SensorPoints, SensorState
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n, so3
from calgraph.recording import Recording
from calgraph.sensors import Message, TurnRate
from calgraph.sensors.kinds import SensorSpec
from calgraph.surfaces.trajectory import SplineTrajectory, Track

# Rates below which there is no motion to compare: at 20 Hz, those of 10 s.
_MIN_RATES = 200
# Time without a rate after which another segment begins, s: turns change within it.
_MAX_GAP = 0.15


class GyroscopeReader:
    """Keeps turn rates."""

    def __init__(self, _: Rig, __: str, ___: Recording, dimension: int, ____: np.random.Generator) -> None:
        self._dimension = dimension
        self._rates: list[tuple[float, ...]] = []

    def add(self, message: Message) -> None:
        """See :class:`Reader`."""
        if isinstance(message, TurnRate):
            self._rates.append((message.stamp, *message.rate))

    def finish(self) -> "GyroscopeSource":
        """The finite rates in order of time, the first of each stamp."""
        rows = np.array(self._rates, dtype=np.float64).reshape(-1, 4)
        rows = rows[np.isfinite(rows).all(axis=1)]
        _, first = np.unique(rows[:, 0], return_index=True)
        return GyroscopeSource(rows[first, 0], rows[first, 1:], self._dimension)


@dataclass(frozen=True, eq=False)
class GyroscopeSource:
    """Turn rates of a gyroscope."""

    times: Array
    """(N,) s, ascending."""
    rates: Array
    """(N, 3) about its axes, rad/s."""
    dimension: int
    """2 or 3."""

    @property
    def gap(self) -> float:
        """See :class:`Source`."""
        return 0.0

    def track(self, rng: np.random.Generator) -> Segments | Rejected:  # noqa: ARG002
        """Its rotation by the integral of the rates; without a place."""
        return self._track(STEP / 2)

    def _track(self, step: float) -> Segments | Rejected:
        """The same, with means of rotations over steps, s."""
        if self.dimension == 2:
            return Rejected("motion in the plane of 2-D scanners does not determine the rotation of a gyroscope")
        if len(self.times) < _MIN_RATES:
            return Rejected(f"it has {len(self.times)} usable turn rates; a drive needs {_MIN_RATES}")
        tracks = []
        for part in np.split(np.arange(len(self.times)), np.flatnonzero(np.diff(self.times) > _MAX_GAP) + 1):
            if self.times[part[-1]] - self.times[part[0]] > 10 * STEP:
                tracks.append(average_poses(_integrate(self.times[part], self.rates[part]), step))
        return Segments(tracks) if tracks else Rejected("its rates have gaps: none is longer than a second")

    def thin(self, rng: np.random.Generator) -> "GyroscopeSource":  # noqa: ARG002
        """All rates."""
        return self

    def points(self, *_: float) -> SensorPoints:
        """None."""
        return no_points(self.dimension)

    def measurements(self, k: int, trajectory: SplineTrajectory, state: SensorState, /) -> Sequence[Measurements]:
        """Turns over short intervals."""
        segments = self._track(STEP)
        assert isinstance(segments, Segments)
        return measure_motions(k, segments, trajectory, state, np.arange(3, 6), wheels=False)


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

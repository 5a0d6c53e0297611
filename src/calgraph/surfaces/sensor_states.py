"""What a joint solution estimates of a sensor, and the points that it measures; n = 2 or 3.

The sensor is on a moving root, or stands still in a world that is its root.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, measure_lengths, se_n

TIMING = 3
"""Number of parameters of the times of beams; see :attr:`SensorPoints.timing`."""
BESIDE_POSE = 3 + TIMING
"""Number of parameters of a sensor besides its pose."""
DRIFT = -TIMING
"""Column of the drift of the clock among the numbers of the state of a stationary sensor."""


@dataclass(frozen=True, eq=False)
class SensorPoints:
    """Points that a sensor measured, with their times."""

    points: Array
    """(N, n) in its frame, m."""
    times: Array
    """(N,) by its clock, s."""
    timing: Array = field(default_factory=lambda: np.zeros(TIMING))
    """(N, 3), or (3,) of all: what its errors of timing add to these times, s, each in separate units: the sweep
    from the first to the last beam, and the delay of odd beams, in periods; the irregularity of stamps, as a share
    of that which was smoothed."""
    flat: bool = False
    """Whether its points are of one plane in space, and show no surface by themselves."""


@dataclass(frozen=True, eq=False)
class SensorState:
    """What is estimated of a sensor."""

    T_root_sensor: Array
    """(n+1, n+1)."""
    clock_offset: float = 0.0
    """Its clock minus the root's, s."""
    range_bias: float = 0.0
    """By which it measures too far, m."""
    range_scale: float = 0.0
    """And relative to the distance."""
    timing: Array = field(default_factory=lambda: np.zeros(TIMING))
    """(3,) as of :attr:`SensorPoints.timing`. Stationary sensors have none of these errors: their first number is
    the drift of the clock, as a share of time."""
    mid_time: float = 0.0
    """Of a stationary sensor, by its clock, s: when a clock that drifts has the offset."""

    def moved(self, step: Array) -> "SensorState":
        """The state after a step (n + d + 6,): pose along the root's axes, clock, bias, scale, and timing."""
        pose = len(step) - BESIDE_POSE
        return replace(
            self,
            T_root_sensor=se_n.retract(self.T_root_sensor, step[:pose]),
            clock_offset=self.clock_offset + float(step[pose]),
            range_bias=self.range_bias + float(step[pose + 1]),
            range_scale=self.range_scale + float(step[pose + 2]),
            timing=self.timing + step[pose + 3 :],
        )

    def deviation_from(self, start: "SensorState") -> Array:
        """(n + d + 6,) in the order of :meth:`moved`; errors of ranges and timing are 0 at the start."""
        pose = se_n.difference(self.T_root_sensor, start.T_root_sensor)
        clock = self.clock_offset - start.clock_offset
        return np.array([*pose, clock, self.range_bias, self.range_scale, *self.timing])

    def date(self, measured: SensorPoints) -> Array:
        """(N,) times of points by the root's clock, s, of a sensor that moves."""
        return np.asarray(measured.times + measured.timing @ self.timing - self.clock_offset)

    def date_stationary(self, times: Array) -> Array:
        """(N,) times by the root's clock, s, of times (N,) by the clock of a stationary sensor."""
        return np.asarray(times - self.clock_offset - self.timing[0] * (times - self.mid_time))

    def correct(self, points: Array) -> Array:
        """Points (N, n) of the sensor without the errors of its ranges, m."""
        ranges = np.linalg.norm(points, axis=1, keepdims=True)
        return np.asarray(points * (1 - self.range_scale - self.range_bias / ranges))

    def place(self, points: Array, beyond: Array | float = 0.0) -> tuple[Array, Array]:
        """Points in the frame of the root, and the derivatives of their places by the state.

        Args:
            points: (N, n) as measured, sensor frame, m.
            beyond: (N,) by which they are moved along their beams, m.

        Returns:
            (N, n) m, and (N, n, n + d + 6); those by clock and timing are 0.
        """
        n = points.shape[1]
        ranges = measure_lengths(points) if n == 3 else np.hypot(*points.T)
        R = se_n.rotation(self.T_root_sensor)
        beams = points / ranges[:, None] @ R.T
        ranges = ranges + beyond
        arms = beams * (ranges * (1 - self.range_scale) - self.range_bias)[:, None]
        pose = n * (n + 1) // 2
        by_state = np.zeros((len(points), n, pose + BESIDE_POSE))
        by_state[:, :, :n] = np.eye(n)
        by_state[:, :, n:pose] = se_n.rotation_jacobian(arms)
        by_state[:, :, pose + 1] = -beams
        by_state[:, :, pose + 2] = -beams * ranges[:, None]
        return arms + se_n.translation(self.T_root_sensor), by_state


def move_states(states: Sequence[SensorState], free: NDArray[np.bool_], step: Array) -> list[SensorState]:
    """The states after a step (P,) of those of their numbers (S, F) that are free."""
    full = np.zeros(free.shape)
    full[free] = step
    return [state.moved(one) for state, one in zip(states, full, strict=True)]


def measure_deviations(states: Sequence[SensorState], start: Sequence[SensorState]) -> Array:
    """(S, F) deviations from the start."""
    return np.array([state.deviation_from(first) for state, first in zip(states, start, strict=True)])


def number_free(free: NDArray[np.bool_]) -> Index:
    """(S, F) place of each free number among all of them; of others, it has no meaning."""
    return np.asarray(np.cumsum(free).reshape(free.shape) - 1)


def expand_covariance(covariance: Array, free: NDArray[np.bool_]) -> Array:
    """(S F, S F) of all numbers from that of the free ones (P, P); 0 of others."""
    whole = np.zeros((free.size,) * 2)
    whole[np.ix_(*[np.flatnonzero(free)] * 2)] = covariance
    return whole

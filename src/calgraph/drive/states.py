"""What the joint solution of a drive estimates of a sensor, and the points that it measures."""

from dataclasses import dataclass, field

import numpy as np

from calgraph.geometry import Array, se_n

TIMING = 3
"""Number of parameters of the times of beams; see :attr:`SensorPoints.timing`."""
BESIDE_POSE = 3 + TIMING
"""Number of parameters of a sensor besides its pose."""


@dataclass(frozen=True, eq=False)
class SensorPoints:
    """Points that a sensor measured during a part of the drive."""

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
    """(3,) as of :attr:`SensorPoints.timing`."""

    def moved(self, step: Array) -> "SensorState":
        """The state after a step (n + d + 6,): pose along the root's axes, clock, bias, scale, and timing."""
        pose = len(step) - BESIDE_POSE
        return SensorState(
            se_n.retract(self.T_root_sensor, step[:pose]),
            self.clock_offset + float(step[pose]),
            self.range_bias + float(step[pose + 1]),
            self.range_scale + float(step[pose + 2]),
            self.timing + step[pose + 3 :],
        )

    def deviation_from(self, start: "SensorState") -> Array:
        """(n + d + 6,) in the order of :meth:`moved`; errors of ranges and timing are 0 at the start."""
        pose = se_n.difference(self.T_root_sensor, start.T_root_sensor)
        clock = self.clock_offset - start.clock_offset
        return np.array([*pose, clock, self.range_bias, self.range_scale, *self.timing])

    def date(self, measured: SensorPoints) -> Array:
        """(N,) times of points by the root's clock, s."""
        return np.asarray(measured.times + measured.timing @ self.timing - self.clock_offset)

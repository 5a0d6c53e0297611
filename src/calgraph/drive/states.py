"""What the joint solution of a drive estimates of a sensor, and the points that it measures."""

from dataclasses import dataclass

from calgraph.geometry import Array, se_n


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

    def moved(self, step: Array) -> "SensorState":
        """The state after a step (n + d + 3,): pose along the root's axes, clock, bias, scale."""
        pose = len(step) - 3
        return SensorState(
            se_n.retract(self.T_root_sensor, step[:pose]),
            self.clock_offset + float(step[pose]),
            self.range_bias + float(step[pose + 1]),
            self.range_scale + float(step[pose + 2]),
        )


@dataclass(frozen=True, eq=False)
class SensorPoints:
    """Points that a sensor measured during a part of the drive."""

    points: Array
    """(N, n) in its frame, m."""
    times: Array
    """(N,) by its clock, s."""

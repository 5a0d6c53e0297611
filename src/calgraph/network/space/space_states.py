"""What the joint solution of a network in space estimates of a sensor."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, measure_lengths, se_n

STATES = 9
"""Numbers of a sensor: pose along the world's axes (6), clock, range bias, range scale."""
CLOCK, BIAS, SCALE = 6, 7, 8


@dataclass(frozen=True, eq=False)
class SpaceState:
    """Of one sensor in a world whose z axis is vertical."""

    T_world_sensor: Array
    """(4, 4)."""
    clock_offset: float = 0.0
    """Its clock minus the root's, s."""
    range_bias: float = 0.0
    """By which it measures too far, m."""
    range_scale: float = 0.0
    """And relative to the distance."""

    def moved(self, step: Array) -> "SpaceState":
        """The state after a step (9,)."""
        return SpaceState(
            se_n.retract(self.T_world_sensor, step[:6]),
            self.clock_offset + float(step[CLOCK]),
            self.range_bias + float(step[BIAS]),
            self.range_scale + float(step[SCALE]),
        )

    def deviation(self, start: "SpaceState") -> Array:
        """(9,) from another state: the step that leads there from it."""
        pose = se_n.difference(self.T_world_sensor, start.T_world_sensor)
        return np.array([
            *pose,
            self.clock_offset - start.clock_offset,
            self.range_bias - start.range_bias,
            self.range_scale - start.range_scale,
        ])  # fmt: skip


def place_points(state: SpaceState, points: Array, beyond: Array | float = 0.0) -> tuple[Array, Array]:
    """Points of a sensor in the world, and the derivatives of their places by its state.

    Args:
        state: of the sensor.
        points: (N, 3) as measured, sensor frame, m.
        beyond: (N,) by which points are moved along their beams, m.

    Returns:
        (N, 3) m, and (N, 3, 9); derivatives by the clock are 0.
    """
    ranges = measure_lengths(points)
    direction = points / ranges[:, None]
    ranges = ranges + beyond
    R = se_n.rotation(state.T_world_sensor)
    beam = direction @ R.T
    arm = beam * (ranges * (1 - state.range_scale) - state.range_bias)[:, None]
    by_state = np.zeros((len(points), 3, STATES))
    by_state[:, :, :3] = np.eye(3)
    by_state[:, :, 3:6] = se_n.rotation_jacobian(arm)
    by_state[:, :, BIAS] = -beam
    by_state[:, :, SCALE] = -beam * ranges[:, None]
    return arm + se_n.translation(state.T_world_sensor), by_state

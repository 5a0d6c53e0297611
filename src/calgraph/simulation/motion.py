"""Trajectory of the board: poses drawn around the robot, and the holds and moves between them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, se3, so3

_SLIP_TIME = 0.3
"""Duration of the slip in a disturbed hold, s; less in a short hold."""

_BOARD_SPACING = np.radians(50.0)
"""Bearing from one board to the next where several are shown simultaneously, rad."""


@dataclass(frozen=True, eq=False)
class BoardPlacement:
    """Placement of board and operator in cylindrical coordinates around the robot: z up, bearing from x."""

    bearing: float
    """Of the board's centre, rad."""
    radius: float
    """Horizontal distance of the board's centre from the world's origin, m."""
    height: float
    """Of the board's centre above the ground, m."""
    R_facing_board: Array
    """(3, 3) rotation relative to facing the robot."""
    standoff: float = 0.6
    """Distance of the operator behind the board, m."""
    side: float = 0.0
    """Lateral offset of the operator from the board's centre, to the left as viewed from the robot, m."""


@dataclass(frozen=True, eq=False)
class SimulatedHold:
    """An interval in which the board rests, or slips once if it is disturbed."""

    start: float
    """s from the start of the recording."""
    end: float
    placement: BoardPlacement
    placement_after_slip: BoardPlacement | None = None
    """Placement in the second part of a disturbed hold."""


@dataclass(frozen=True, eq=False)
class BoardTrajectory:
    """The placement of the board over time, as knots connected by minimum-jerk moves."""

    times: Array
    """(K,) ascending, s from the start of the recording; the room is empty before the first."""
    placements: tuple[BoardPlacement, ...]
    """K placements; the board rests between two equal neighbours."""
    holds: tuple[SimulatedHold, ...]
    end: float
    """End of the recording, s."""

    def placement_at(self, time: float) -> BoardPlacement | None:
        """Placement at a time, s; None while the room is empty."""
        if time < self.times[0]:
            return None
        k = int(np.searchsorted(self.times, time, side="right"))
        if k == len(self.times):
            return self.placements[-1]
        a, b = self.placements[k - 1], self.placements[k]
        if a is b:
            return a
        return _interpolate(a, b, (time - self.times[k - 1]) / (self.times[k] - self.times[k - 1]))

    def is_static(self, start: float, end: float) -> bool:
        """Whether nothing moves between two times, both included."""
        if end < self.times[0]:
            return True
        if start < self.times[0]:
            return False
        first = int(np.searchsorted(self.times, start, side="right")) - 1
        last = min(int(np.searchsorted(self.times, end, side="left")), len(self.times) - 1)
        return all(self.placements[k] is self.placements[first] for k in range(first, last + 1))


def pose_from_placement(placement: BoardPlacement) -> Array:
    """``T_world_board`` (4, 4): z out of the printed face towards the robot, y up, x right for a reader."""
    c, s = np.cos(placement.bearing), np.sin(placement.bearing)
    R_world_facing = np.array([[s, 0, -c], [-c, 0, -s], [0, 1, 0]])
    position = np.array([placement.radius * c, placement.radius * s, placement.height])
    return se3.pose(R_world_facing @ placement.R_facing_board, position)


def place_all_boards(placement: BoardPlacement, count: int) -> tuple[BoardPlacement, ...]:
    """Placements of all boards: the first, and further ones that other operators hold to its left.

    Rotations alternate between R and its transpose, so that boards are not parallel.
    """
    turns = (placement.R_facing_board, placement.R_facing_board.T)
    return (
        placement,
        *(
            replace(placement, bearing=placement.bearing + i * _BOARD_SPACING, R_facing_board=turns[i % 2])
            for i in range(1, count)
        ),
    )


def draw_placements(
    rng: np.random.Generator,
    bearings: Sequence[float],
    radii: Sequence[float],
    samples: int,
    max_rotation: float,
    heights: tuple[float, float],
) -> tuple[BoardPlacement, ...]:
    """Draws random rotations at every bearing and radius (MSG-Cal, section VI-A), in the order given.

    Args:
        rng: draws rotations, heights, and the operator's position.
        bearings: rad.
        radii: m.
        samples: rotations at each bearing and radius.
        max_rotation: each of roll, pitch and yaw is uniform between minus this and this, rad.
        heights: lowest and highest centre of the board, m.
    """
    return tuple(
        BoardPlacement(
            bearing=bearing,
            radius=radius,
            height=rng.uniform(*heights),
            R_facing_board=_rotation_from_rpy(rng.uniform(-max_rotation, max_rotation, 3)),
            standoff=rng.uniform(0.55, 0.7),
            side=rng.uniform(-0.25, 0.25),
        )
        for bearing in bearings
        for radius in radii
        for _ in range(samples)
    )


def schedule_holds(
    placements: Sequence[BoardPlacement],
    *,
    background: float,
    move_time: float,
    hold_end: Callable[[float], float],
    placements_after_slip: Sequence[BoardPlacement | None],
) -> BoardTrajectory:
    """Builds the trajectory through all placements.

    Args:
        placements: one for each capture.
        background: duration of the empty room at the start, s.
        move_time: from one placement to the next, s.
        hold_end: the end of a hold that starts at the given time, s.
        placements_after_slip: where each capture's board slips to during its hold, None where it rests.
    """
    time = background
    # The operator comes in from farther out, so that the first move does not start in a capture's pose.
    knots: list[tuple[float, BoardPlacement]] = [(time, replace(placements[0], radius=placements[0].radius + 0.8))]
    holds = []
    for placement, placement_after_slip in zip(placements, placements_after_slip, strict=True):
        start = time + move_time
        time = hold_end(start)
        holds.append(SimulatedHold(start, time, placement, placement_after_slip))
        knots.append((start, placement))
        if placement_after_slip is not None:
            middle = (start + time) / 2
            knots += [(middle, placement), (min(middle + _SLIP_TIME, (middle + time) / 2), placement_after_slip)]
        knots.append((time, placement_after_slip or placement))
    return BoardTrajectory(np.array([t for t, _ in knots]), tuple(s for _, s in knots), tuple(holds), time)


def displace_board(
    placement: BoardPlacement, rng: np.random.Generator, distance: float, angle: float
) -> BoardPlacement:
    """Displaces the board by a distance (m) and an angle (rad) in random directions."""
    step = distance * _random_direction(rng)
    return replace(
        placement,
        bearing=placement.bearing + step[0] / placement.radius,
        radius=placement.radius + step[1],
        height=placement.height + step[2],
        R_facing_board=so3.exp(angle * _random_direction(rng)) @ placement.R_facing_board,
    )


def _random_direction(rng: np.random.Generator) -> Array:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def _interpolate(a: BoardPlacement, b: BoardPlacement, fraction: float) -> BoardPlacement:
    """Minimum-jerk interpolation: velocity and acceleration vanish at both ends, as in human motion."""
    s = fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
    turn = so3.log(a.R_facing_board.T @ b.R_facing_board)
    return BoardPlacement(
        bearing=a.bearing + s * (b.bearing - a.bearing),
        radius=a.radius + s * (b.radius - a.radius),
        height=a.height + s * (b.height - a.height),
        R_facing_board=a.R_facing_board @ so3.exp(s * turn),
        standoff=a.standoff + s * (b.standoff - a.standoff),
        side=a.side + s * (b.side - a.side),
    )


def _rotation_from_rpy(angles: Array) -> Array:
    roll, pitch, yaw = (so3.exp(angle * axis) for angle, axis in zip(angles, np.eye(3), strict=True))
    return np.asarray(yaw @ pitch @ roll)

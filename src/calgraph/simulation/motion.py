"""Where the board is when: poses drawn around the robot, and the timeline of holds and moves between them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, se3, so3

_DISTURBANCE_TIME = 0.3
"""How long the board takes to slip in a disturbed hold, s; less in a hold that is over before."""

_APART = np.radians(50.0)
"""From one board to the next, seen from the robot, where several are shown at once."""


@dataclass(frozen=True, eq=False)
class Stance:
    """A place of board and operator, in cylinder coordinates around the robot: z up, bearing from x."""

    bearing: float
    """Of the board's centre, rad."""
    radius: float
    """Horizontal distance of the board's centre from the world's origin, m."""
    height: float
    """Of the board's centre above the ground, m."""
    R_facing_board: Array
    """(3, 3) rotation from squarely facing the robot."""
    standoff: float = 0.6
    """How far behind the board the operator stands, m."""
    side: float = 0.0
    """How far to the left of the board's centre, seen from the robot, the operator stands, m."""


@dataclass(frozen=True, eq=False)
class Hold:
    """A time in which the board is to rest."""

    start: float
    """s from the start of the recording."""
    end: float
    stance: Stance
    slipped: Stance | None = None
    """Where the board is in the second part of a disturbed hold."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """The stance of the board over time, as knots that smooth moves connect."""

    times: Array
    """(K,) ascending, s from the start of the recording; nobody is in the room before the first."""
    stances: tuple[Stance, ...]
    """K stances; two equal neighbours are a rest."""
    holds: tuple[Hold, ...]
    end: float
    """End of the recording, s."""

    def stance(self, time: float) -> Stance | None:
        """Where the board is, or None before it comes into the room."""
        if time < self.times[0]:
            return None
        k = int(np.searchsorted(self.times, time, side="right"))
        if k == len(self.times):
            return self.stances[-1]
        a, b = self.stances[k - 1], self.stances[k]
        if a is b:
            return a
        return _between(a, b, (time - self.times[k - 1]) / (self.times[k] - self.times[k - 1]))

    def still(self, start: float, end: float) -> bool:
        """Whether nothing moves between two times, both included."""
        if end < self.times[0]:
            return True
        if start < self.times[0]:
            return False
        first = int(np.searchsorted(self.times, start, side="right")) - 1
        last = min(int(np.searchsorted(self.times, end, side="left")), len(self.times) - 1)
        return all(self.stances[k] is self.stances[first] for k in range(first, last + 1))


def board_pose(stance: Stance) -> Array:
    """``T_world_board`` (4, 4): z out of the face towards the robot, y up, x right as a reader sees it."""
    c, s = np.cos(stance.bearing), np.sin(stance.bearing)
    R_world_facing = np.array([[s, 0, -c], [-c, 0, -s], [0, 1, 0]])
    position = np.array([stance.radius * c, stance.radius * s, stance.height])
    return se3.pose(R_world_facing @ stance.R_facing_board, position)


def stances_of_all(stance: Stance, count: int) -> tuple[Stance, ...]:
    """The stance of the first board and those of further ones, which other operators carry along to its left.

    Each is turned the other way than the one before, so that boards are as little parallel as single ones are.
    """
    turns = (stance.R_facing_board, stance.R_facing_board.T)
    return (
        stance,
        *(
            replace(stance, bearing=stance.bearing + i * _APART, R_facing_board=turns[i % 2])
            for i in range(1, count)
        ),
    )


def draw_stances(
    rng: np.random.Generator,
    bearings: Sequence[float],
    radii: Sequence[float],
    samples: int,
    max_rotation: float,
    heights: tuple[float, float],
) -> tuple[Stance, ...]:
    """Random rotations at every bearing and radius (MSG-Cal, section VI-A), in the order given.

    Args:
        rng: draws rotations, heights, and where the operator stands.
        bearings: rad.
        radii: m.
        samples: rotations at each bearing and radius.
        max_rotation: each of roll, pitch and yaw is uniform between minus this and this, rad.
        heights: lowest and highest centre of the board, m.

    """
    return tuple(
        Stance(
            bearing=bearing,
            radius=radius,
            height=rng.uniform(*heights),
            R_facing_board=_from_roll_pitch_yaw(rng.uniform(-max_rotation, max_rotation, 3)),
            standoff=rng.uniform(0.55, 0.7),
            side=rng.uniform(-0.25, 0.25),
        )
        for bearing in bearings
        for radius in radii
        for _ in range(samples)
    )


def schedule(
    stances: Sequence[Stance],
    *,
    background: float,
    move_time: float,
    hold_end: Callable[[float], float],
    disturbed: Sequence[Stance | None],
) -> Timeline:
    """The timeline that visits the stances.

    Args:
        stances: one for each capture.
        background: how long the room stays empty at the start, s.
        move_time: from one stance to the next, s.
        hold_end: the end of a hold that starts at the given time, s.
        disturbed: where each capture's board slips to during its hold, None where it rests.

    """
    time = background
    # The operator comes in from farther out, so that the first move does not start in a capture's pose.
    knots: list[tuple[float, Stance]] = [(time, replace(stances[0], radius=stances[0].radius + 0.8))]
    holds = []
    for stance, slipped in zip(stances, disturbed, strict=True):
        start = time + move_time
        time = hold_end(start)
        holds.append(Hold(start, time, stance, slipped))
        knots.append((start, stance))
        if slipped is not None:
            middle = (start + time) / 2
            knots += [(middle, stance), (min(middle + _DISTURBANCE_TIME, (middle + time) / 2), slipped)]
        knots.append((time, slipped or stance))
    return Timeline(np.array([t for t, _ in knots]), tuple(s for _, s in knots), tuple(holds), time)


def slip(stance: Stance, rng: np.random.Generator, distance: float, angle: float) -> Stance:
    """The stance after the board slipped by a distance (m) and an angle (rad) in random directions."""
    step = distance * _unit(rng)
    return replace(
        stance,
        bearing=stance.bearing + step[0] / stance.radius,
        radius=stance.radius + step[1],
        height=stance.height + step[2],
        R_facing_board=so3.exp(angle * _unit(rng)) @ stance.R_facing_board,
    )


def _unit(rng: np.random.Generator) -> Array:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def _between(a: Stance, b: Stance, fraction: float) -> Stance:
    """Minimum-jerk move: velocity and acceleration vanish at both ends, as when a person moves."""
    s = fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
    turn = so3.log(a.R_facing_board.T @ b.R_facing_board)
    return Stance(
        bearing=a.bearing + s * (b.bearing - a.bearing),
        radius=a.radius + s * (b.radius - a.radius),
        height=a.height + s * (b.height - a.height),
        R_facing_board=a.R_facing_board @ so3.exp(s * turn),
        standoff=a.standoff + s * (b.standoff - a.standoff),
        side=a.side + s * (b.side - a.side),
    )


def _from_roll_pitch_yaw(angles: Array) -> Array:
    roll, pitch, yaw = (so3.exp(angle * axis) for angle, axis in zip(angles, np.eye(3), strict=True))
    return np.asarray(yaw @ pitch @ roll)

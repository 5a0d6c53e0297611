"""How a simulated robot drives: its route in the plane, and its motion in space over the ground with suspension.

The base frame lies on the ground below the middle of the rear axle: x ahead, z up.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from calgraph.geometry import Array, se3, so3

PathKind = Literal["ordinary", "planar", "straight", "constant_turn", "turn_on_spot", "stops", "carried"]

INTERVAL = 0.01
"""Between samples of the motion, s."""
MARGIN = 1.0
"""Of the motion before and after the recording, s: sweeps and clocks overlap its ends."""
_MAX_ACCELERATION, _MAX_TURN_RATE, _MAX_TURN_ACCELERATION = 0.8, 0.7, 1.5
"""Of a robot in a building, m/s², rad/s, rad/s²."""
_SMOOTHING = 0.12
"""Standard deviation by which drives smooth commands, s."""
_TYRE = 0.05
"""Standard deviation by which tyres and suspension smooth the profile of the ground, s."""


@dataclass(frozen=True, eq=False)
class Route:
    """The base in the plane, at evenly spaced times."""

    times: Array
    """(K,) s from the start of the recording."""
    positions: Array
    """(K, 2) m."""
    yaws: Array
    """(K,) continuous, rad."""
    speeds: Array
    """(K,) ahead, negative in reverse, m/s."""
    turn_rates: Array
    """(K,) rad/s."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The base in space, smooth in time."""

    times: Array
    """(K,) of the samples, s from the start of the recording."""
    samples: Array
    """(K, 6) x, y, z, m, and yaw, pitch, roll, rad."""

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.samples)

    def poses(self, times: Array) -> Array:
        """(N, 4, 4) T_world_base."""
        samples = self._spline(times)
        return se3.pose(_rotation(*samples[:, 3:].T), samples[:, :3])

    def rates(self, times: Array) -> Array:
        """(N, 3) angular velocities in the base frame, rad/s."""
        _, pitch, roll = self._spline(times)[:, 3:].T
        yaw_rate, pitch_rate, roll_rate = self._spline(times, 1)[:, 3:].T
        return np.stack(
            [
                roll_rate - yaw_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
                -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
            ],
            axis=-1,
        )


def draw_route(
    kind: PathKind, reach: tuple[float, float], duration: float, slip: float, rng: np.random.Generator
) -> Route:
    """Draws a route through an area.

    Args:
        kind: of the path.
        reach: half of the area's length and width, m; straight paths leave it.
        duration: of the recording, s.
        slip: sideways velocity per speed and turn rate, s; the axis of turning shifts by speed times slip.
        rng: for the route.
    """
    times = np.arange(-MARGIN, duration + MARGIN, INTERVAL)
    if kind == "carried":
        return _carry(times, reach, rng)
    targets = _draw_stops(times, rng) if kind == "stops" else _draw_speeds(times, kind != "constant_turn", rng)
    if kind == "straight":
        # No driver holds a line better than half a degree.
        speeds = _limit(targets, _MAX_ACCELERATION)
        turns = np.gradient(np.radians(0.4) * draw_drift(len(times), 1.0, rng), INTERVAL)
    elif kind == "constant_turn":
        turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.4)
        speeds = _limit(targets, _MAX_ACCELERATION)
        turns = _limit(np.full(len(times), turn), _MAX_TURN_ACCELERATION)
    elif kind == "turn_on_spot":
        speeds, sign = np.zeros(len(times)), np.sign(np.sin(2 * np.pi * times / rng.uniform(14, 22)))
        turns = _limit(sign * rng.uniform(0.4, 0.7), _MAX_TURN_ACCELERATION)
    else:
        speeds, turns = _pursue_waypoints(targets, np.array(reach), rng)
    speeds = gaussian_filter1d(speeds, _SMOOTHING / INTERVAL)
    turns = gaussian_filter1d(turns, _SMOOTHING / INTERVAL)
    sideways = -slip * speeds * turns + 0.5 * slip * np.abs(speeds) * draw_drift(len(times), 0.5, rng)
    yaws = rng.uniform(-np.pi, np.pi) + cumulative_trapezoid(turns, dx=INTERVAL, initial=0)
    c, s = np.cos(yaws), np.sin(yaws)
    velocity = np.stack([c * speeds - s * sideways, s * speeds + c * sideways], axis=-1)
    positions = cumulative_trapezoid(velocity, dx=INTERVAL, axis=0, initial=0)
    return Route(times, positions, yaws, speeds, turns)


def draw_motion(
    route: Route,
    ground_height: Callable[[Array], Array],
    wheels: tuple[float, float],
    bounce: float,
    rng: np.random.Generator,
) -> Motion:
    """Drives a route over the ground.

    Args:
        route: of the base.
        ground_height: (N,) heights of the ground at (N, 2).
        wheels: wheelbase and track, m.
        bounce: size of the suspension's motion: 0 for none, 1 for that of a robot on pneumatic tyres.
        rng: for the suspension.
    """
    heights = {
        place: gaussian_filter1d(ground_height(_beside(route, *place)), _TYRE / INTERVAL)
        for place in ((x, y) for x in (0.0, wheels[0]) for y in (-wheels[1] / 2, wheels[1] / 2))
    }
    rear_right, rear_left, front_right, front_left = heights.values()
    z = (rear_right + rear_left) / 2
    pitch = -np.arctan((front_right + front_left - rear_right - rear_left) / (2 * wheels[0]))
    roll = np.arctan((front_left + rear_left - front_right - rear_right) / (2 * wheels[1]))
    # It squats when it accelerates and leans out of curves.
    accelerations = np.gradient(route.speeds, INTERVAL)
    pitch = pitch - bounce * 0.008 * gaussian_filter1d(accelerations, 0.2 / INTERVAL)
    roll = roll + bounce * 0.01 * gaussian_filter1d(route.speeds * route.turn_rates, 0.2 / INTERVAL)
    z = z + bounce * 0.003 * _draw_vibration(route, rng)
    pitch = pitch + bounce * np.radians(0.3) * _draw_vibration(route, rng)
    roll = roll + bounce * np.radians(0.35) * _draw_vibration(route, rng)
    return Motion(route.times, np.column_stack([route.positions, z, route.yaws, pitch, roll]))


def carry_motion(route: Route, rng: np.random.Generator) -> Motion:
    """A rig in the hands of a person: it tilts by some 15 degrees, and hands tremble."""
    count = len(route.times)
    height = 0.5 + 0.15 * draw_drift(count, 1.5, rng)
    pitch, roll = (0.25 * draw_drift(count, 1.0, rng) + 0.003 * draw_drift(count, 0.05, rng) for _ in range(2))
    return Motion(route.times, np.column_stack([route.positions, height, route.yaws, pitch, roll]))


def draw_drift(count: int, correlation: float, rng: np.random.Generator) -> Array:
    """(count,) a smooth random process of unit variance, correlated over some seconds, at :data:`INTERVAL`."""
    width = correlation / INTERVAL
    # White noise of unit variance has the variance 1 / (2 sqrt(pi) width) after the filter.
    values = gaussian_filter1d(rng.normal(size=count), width, mode="wrap")
    return np.asarray(values * np.sqrt(2 * np.sqrt(np.pi) * width))


def _rotation(yaw: Array, pitch: Array, roll: Array) -> Array:
    about = [
        so3.exp(angle[:, None] * axis) for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)
    ]
    return np.asarray(about[0] @ about[1] @ about[2])


def _beside(route: Route, x: float, y: float) -> Array:
    """(K, 2) places of a point of the base frame."""
    c, s = np.cos(route.yaws), np.sin(route.yaws)
    return route.positions + np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _draw_speeds(times: Array, varied: bool, rng: np.random.Generator) -> Array:
    """(K,) wanted speeds: cruises, stops and, on varied drives, reversing, m/s."""
    if not varied:
        return np.full(len(times), rng.uniform(0.6, 1.2))
    speeds = np.zeros(len(times))
    time = -MARGIN
    while time < times[-1]:
        manoeuvres = ((rng.uniform(1.0, 2.5), 0.0), (rng.uniform(2.0, 3.5), -rng.uniform(0.3, 0.6)), (0.0, 0.0))
        cruise = (rng.uniform(5.0, 10.0), rng.uniform(0.6, 1.4))
        for length, speed in (cruise, manoeuvres[int(rng.integers(3))]):
            speeds[(times >= time) & (times < time + length)] = speed
            time += length
    return speeds


def _draw_stops(times: Array, rng: np.random.Generator) -> Array:
    """(K,) wanted speeds of a robot that stops every four or five seconds, m/s."""
    speeds, time = np.zeros(len(times)), -MARGIN
    while time < times[-1]:
        for length, speed in ((rng.uniform(2.0, 3.2), rng.uniform(0.5, 1.0)), (rng.uniform(1.5, 2.0), 0.0)):
            speeds[(times >= time) & (times < time + length)] = speed
            time += length
    return speeds


def _carry(times: Array, reach: tuple[float, float], rng: np.random.Generator) -> Route:
    """The place of a rig that a person carries through an area and turns to all sides."""
    positions = np.stack([0.4 * half * draw_drift(len(times), 2.5, rng) for half in reach], axis=-1)
    yaws = rng.uniform(-np.pi, np.pi) + 2.5 * draw_drift(len(times), 5.0, rng)
    velocity = np.gradient(positions, INTERVAL, axis=0)
    return Route(times, positions, yaws, np.linalg.norm(velocity, axis=1), np.gradient(yaws, INTERVAL))


def _limit(wanted: Array, rate: float) -> Array:
    """Values that follow the wanted ones from 0 at a limited rate per second."""
    values, value, step = np.empty(len(wanted)), 0.0, rate * INTERVAL
    for k, target in enumerate(wanted.tolist()):
        value += min(max(target - value, -step), step)
        values[k] = value
    return values


def _pursue_waypoints(wanted: Array, reach: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Speeds and turn rates (K,) of a robot that drives from waypoint to waypoint, from the middle of the area."""
    speeds, turns = np.zeros(len(wanted)), np.zeros(len(wanted))
    x = y = yaw = speed = turn = 0.0
    goal, since = rng.uniform(-reach, reach), 0
    swing = _MAX_TURN_RATE * rng.choice([-1, 1], len(wanted) // 100 + 1) * rng.random(len(wanted) // 100 + 1)
    for k, target in enumerate(wanted.tolist()):
        if np.hypot(goal[0] - x, goal[1] - y) < 1.0 or since > 8 / INTERVAL:
            goal, since = rng.uniform(-reach, reach), 0
        since += 1
        error = (np.arctan2(goal[1] - y, goal[0] - x) - yaw + np.pi) % (2 * np.pi) - np.pi
        if target > 0:
            wanted_turn = float(np.clip(1.5 * error, -_MAX_TURN_RATE, _MAX_TURN_RATE))
        else:
            wanted_turn = float(swing[k // 100]) * (0.5 if target < 0 else 0.0)
        # It slows down where the goal is not ahead.
        goal_speed = target * max(0.3, np.cos(error)) if target > 0 else target
        speed += float(np.clip(goal_speed - speed, -_MAX_ACCELERATION * INTERVAL, _MAX_ACCELERATION * INTERVAL))
        most = _MAX_TURN_ACCELERATION * INTERVAL
        turn += float(np.clip(wanted_turn - turn, -most, most))
        yaw += turn * INTERVAL
        x, y = x + speed * np.cos(yaw) * INTERVAL, y + speed * np.sin(yaw) * INTERVAL
        speeds[k], turns[k] = speed, turn
    return speeds, turns


def _draw_vibration(route: Route, rng: np.random.Generator) -> Array:
    """(K,) sum of oscillations of the body, the tyres and the frame, of unit amplitude at 1 m/s."""
    envelope = 0.1 + np.minimum(gaussian_filter1d(np.abs(route.speeds), 0.3 / INTERVAL), 1.5)
    total = np.zeros(len(route.times))
    for low, high, amplitude in ((0.7, 1.6, 0.7), (2.0, 3.5, 0.4), (4.0, 7.0, 0.12), (9.0, 13.0, 0.03)):
        wobble = 2 * draw_drift(len(route.times), 1.0, rng)
        phase = 2 * np.pi * rng.uniform(low, high) * route.times + rng.uniform(0, 2 * np.pi) + wobble
        total += amplitude * np.sin(phase)
    return np.asarray(envelope * total)

"""Walks of people through a building: around walls and each other, from goal to goal, with stops.

Each person follows the shortest path to the next goal. Ten times a second each chooses the velocity that follows
it best without a collision within the next 1.6 s, as velocity-obstacle crowd models do (Fiorini and Shiller 1998).
Positions are then smoothed in time, and the body turns with the walk.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation.network_floor import Boxes, FreeSpace
from calgraph.simulation.network_scenario import PeopleOptions

_DECISION_INTERVAL = 0.1
"""Time between two choices of a velocity, s."""
SAMPLE_INTERVAL = 0.01
"""Time between two samples of a walk, s: chords of a walk are within 0.1 mm of it."""
_SMOOTHING_SIGMA = 0.25
"""Standard deviation of the Gaussian filter of the positions, s."""
_LOOKAHEAD_TIMES = np.array([0.1, 0.4, 0.8, 1.2, 1.6])
"""Times at which a velocity is checked for collisions, s."""
_PEOPLE_COSTS = 4.0 * (1 - _LOOKAHEAD_TIMES / 2)
"""Cost of a collision with a person at those times, relative to the speed: decreasing with time."""
_WALL_COSTS = np.array([3.0, 1.0, 0.3, 0.0, 0.0])
"""Cost of a collision with a wall; the path leads around walls that are farther ahead."""
_STANDING_COST = 0.5
"""Cost of standing, relative to the speed, so that people do not stop before a bend."""
_CANDIDATE_TURNS = np.radians([0, -15, 15, -30, 30, -50, 50, -75, 75, -105, 105, -150, 150])
"""Directions of candidate velocities relative to the wanted one, rad."""
_CANDIDATE_SPEEDS = np.array([1.0, 0.7, 0.35])
"""Speeds of candidate velocities relative to the walker's."""
_HEEDED_DISTANCE = 6.0
"""Walkers farther apart do not heed each other, m."""
_INDEX_INTERVAL = 5.0
"""Of the times in which bodies are indexed, s: walkers stay within some metres."""
_GOAL_RADIUS = 0.5
"""A goal is reached within this distance, m."""
_MAX_STUCK_TIME = 2.5
"""A walker who is slowed down for longer takes another goal, s."""
_SMOOTHING_MARGIN = 0.12
"""Largest displacement by smoothing, m; planned on top of the clearance."""


@dataclass(frozen=True, eq=False)
class Section:
    """How a body's horizontal section changes with the height of the scan plane."""

    height: float
    """At which the body's positions and outline hold, m."""
    heights: Array
    """(H,) m, increasing."""
    offsets: Array
    """(H, K, 2) of the section's centre from the body's position at each sample, m."""
    sizes: Array
    """(H,) factors of the body's outline."""


@dataclass(frozen=True, eq=False)
class SimulatedWalk:
    """One body over time."""

    axes: Array
    """(2,) radii across and along its heading, m."""
    start: float
    """Time of the first sample, s from the start of the recording; the body is absent before."""
    positions: Array
    """(K, 2) centre at every hundredth of a second, m."""
    headings: Array
    """(K,) direction it faces, rad, unwrapped."""
    outline: Array | None = None
    """(L, 2) corners, counter-clockwise, of a convex polygon with x along the heading, m; none for an ellipse."""
    section: Section | None = None
    """Left out where the body is the same at all heights; only outlines have it."""

    @cached_property
    def reach(self) -> float:
        """The largest distance of the edge from the centre, m."""
        if self.outline is None:
            return float(self.axes.max())
        return float(np.linalg.norm(self.outline, axis=1).max())

    @cached_property
    def full_reach(self) -> float:
        """The same for all heights of the scan plane, m."""
        if self.section is None:
            return self.reach
        offset = np.linalg.norm(self.section.offsets, axis=-1).max(initial=0.0)
        return float(offset + self.section.sizes.max() * self.reach)

    @cached_property
    def max_speed(self) -> float:
        """m/s."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return float(steps.max(initial=0.0)) / SAMPLE_INTERVAL

    def pose_at(self, times: Array) -> tuple[Array, Array]:
        """Centres (..., 2) and headings (...) at times (...), s; NaN before the first and after the last one."""
        first, part = self._samples(times)
        places = self.positions[first] + part[..., None] * (self.positions[first + 1] - self.positions[first])
        return places, self.headings[first] + part * (self.headings[first + 1] - self.headings[first])

    def section_at(self, times: Array, heights: Array) -> tuple[Array, Array]:
        """Offsets (N, 2) of the centre, m, and sizes (N,) of the section at times (N,), s, and heights (N,), m."""
        assert self.section is not None
        first, _ = self._samples(times)
        grid = self.section.heights
        level = np.clip(np.searchsorted(grid, heights) - 1, 0, len(grid) - 2)
        share = np.clip((heights - grid[level]) / (grid[level + 1] - grid[level]), 0, 1)
        below, above = self.section.offsets[level, first], self.section.offsets[level + 1, first]
        return below + share[:, None] * (above - below), np.interp(heights, grid, self.section.sizes)

    def _samples(self, times: Array) -> tuple[NDArray[np.intp], Array]:
        """Indices (...) of the samples before times (...), and the shares (...) of the interval passed, or NaN."""
        sample = (times - self.start) / SAMPLE_INTERVAL
        present = (sample >= 0) & (sample <= len(self.positions) - 1)
        first = np.clip(np.floor(np.where(present, sample, 0)).astype(np.intp), 0, len(self.positions) - 2)
        return first, np.where(present, sample - first, np.nan)


@dataclass(frozen=True, eq=False)
class BodyIndex:
    """Which bodies are near to a place during some time."""

    bodies: tuple[SimulatedWalk, ...]

    @cached_property
    def _intervals(self) -> list[Boxes]:
        """Where the bodies are in each interval of time, and how far they reach; absent ones are nowhere."""
        ends = [body.start + SAMPLE_INTERVAL * len(body.positions) for body in self.bodies]
        count = int(max(ends, default=0.0) / _INDEX_INTERVAL) + 1
        low, high = np.full((2, count, len(self.bodies), 2), np.nan)
        for k, i in np.ndindex(count, len(self.bodies)):
            body = self.bodies[i]
            first, last = ((k + j) * _INDEX_INTERVAL - body.start for j in (0, 1))
            begin, end = (round(time / SAMPLE_INTERVAL) for time in (first, last))
            places = body.positions[max(begin - 1, 0) : max(end + 2, 0)]
            if len(places):
                low[k, i] = places.min(axis=0) - body.full_reach
                high[k, i] = places.max(axis=0) + body.full_reach
        return [Boxes(*corners) for corners in zip(low, high, strict=True)]

    def near(self, places: Array, distance: float, first: float, last: float) -> list[SimulatedWalk]:
        """The bodies that are near to one of some places between two times, and some others, in order.

        Args:
            places: (P, 2) m.
            distance: from a place to the nearest point of the body, m.
            first: s from the start of the recording.
            last: s.
        """
        intervals = self._intervals[int(first / _INDEX_INTERVAL) : int(last / _INDEX_INTERVAL) + 1]
        found = [one.near(place - distance, place + distance) for one in intervals for place in places]
        return [self.bodies[k] for k in np.unique(np.concatenate(found))] if found else []


class _Crowd:
    """The walkers, and where they are."""

    def __init__(self) -> None:
        self.walkers: list[_Walker] = []
        self._positions = np.zeros((0, 2))

    def add(self, walker: "_Walker") -> None:
        """Adds a walker at its place."""
        self.walkers.append(walker)
        self._positions = np.vstack([self._positions, walker.position])

    def move(self, number: int, position: Array) -> None:
        """Moves a walker to a place (2,)."""
        self.walkers[number].position = position
        self._positions[number] = position

    def near(self, position: Array) -> "list[_Walker]":
        """All within the distance at which walkers heed each other, and some beyond, in order."""
        near = (np.abs(self._positions - position) <= _HEEDED_DISTANCE).all(axis=1)
        return [self.walkers[k] for k in np.flatnonzero(near)]


@dataclass
class _Walker:
    """State of one person during the simulation."""

    axes: Array
    reach: float
    """Of the body, or of all that walk together, m."""
    free_space: FreeSpace
    speed: float
    stations: Array
    """(K, 2) goals in order, or none."""
    trip: float
    """Distance within which random goals are drawn, and beyond which paths go around only where they must, m."""
    position: Array
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    path: Array = field(default_factory=lambda: np.zeros((0, 2)))
    visited: int = 0
    stopped_until: float = 0.0
    stuck_time: float = 0.0


@dataclass(frozen=True, eq=False)
class Party:
    """What walks together: one body, a couple, or a person with a cart."""

    reach: float
    """Radius of the circle about its centre that stays free, m."""
    free_space: FreeSpace
    """Where its centre may be."""


def body_clearance(people: PeopleOptions, reach: float) -> float:
    """Planned minimum distance of a centre from walls, m."""
    return reach + people.clearance + _SMOOTHING_MARGIN


def draw_walks(
    parties: Sequence[Party],
    stations: Array,
    people: PeopleOptions,
    start: float,
    end: float,
    rng: np.random.Generator,
    trip: float = np.inf,
) -> tuple[SimulatedWalk, ...]:
    """Draws the walks of all parties, with radii of one person each.

    Args:
        parties: who walk.
        stations: (K, 2) goals in order; each person starts at another one and takes either direction; with none,
            goals are random.
        people: speed and size.
        start: s from the start of the recording.
        end: s.
        rng: draws everything random.
        trip: distance within which random goals are drawn, along each axis, m.

    Raises:
        InputError: the floor is too small for all of them.
    """
    crowd = _init_walkers(parties, stations, people, trip, rng)
    steps = int(np.ceil((end - start) / _DECISION_INTERVAL)) + 2
    places = np.empty((steps, len(parties), 2))
    for step in range(steps):
        for k in range(len(parties)):
            _advance(crowd, k, people, step * _DECISION_INTERVAL, rng)
        places[step] = np.reshape([walker.position for walker in crowd.walkers], (-1, 2))
    return tuple(_smooth_walk(walker.axes, places[:, k], start) for k, walker in enumerate(crowd.walkers))


def _init_walkers(
    parties: Sequence[Party], stations: Array, people: PeopleOptions, trip: float, rng: np.random.Generator
) -> _Crowd:
    crowd = _Crowd()
    for k, party in enumerate(parties):
        free_space = party.free_space
        scale = 1 + rng.uniform(-people.axes_spread, people.axes_spread, 2)
        axes = np.full(2, people.diameter / 2) if people.kind == "cylinder" else scale * people.axes
        order = np.roll(stations, -round(k * len(stations) / len(parties)), axis=0)
        if len(order) and rng.random() < 0.5:
            order = np.roll(order[::-1], 1, axis=0)
        place = free_space.nearest_free(order[0]) if len(order) else free_space.random_place(rng)
        for _ in range(100):
            if all(
                np.linalg.norm(place - other.position)
                > _min_center_distance(people, party.reach + other.reach) + 0.2
                for other in crowd.near(place)
            ):
                break
            place = free_space.random_place(rng)
        else:
            raise InputError(f"people.count: {len(parties)} do not fit on the floor, only {len(crowd.walkers)} do")
        speed = people.speed * (1 + rng.uniform(-people.speed_spread, people.speed_spread))
        crowd.add(_Walker(axes, party.reach, free_space, speed, order, trip, place))
    return crowd


def _min_center_distance(people: PeopleOptions, reaches: float) -> float:
    """Minimum distance of two centres, m, from the sum of both reaches."""
    return reaches + people.clearance + _SMOOTHING_MARGIN


def _advance(crowd: _Crowd, number: int, people: PeopleOptions, now: float, rng: np.random.Generator) -> None:
    """Moves one person by one step."""
    walker = crowd.walkers[number]
    if now < walker.stopped_until:
        walker.velocity = np.zeros(2)
        return
    if people.stop_every > 0 and rng.random() < _DECISION_INTERVAL / people.stop_every:
        walker.stopped_until = now + rng.exponential(people.stop_time)
    if (
        len(walker.path) == 0
        or walker.stuck_time > _MAX_STUCK_TIME
        or np.linalg.norm(walker.path[-1] - walker.position) < _GOAL_RADIUS
    ):
        goal = _next_goal(walker, rng)
        walker.path = walker.free_space.plan_path(walker.position, goal, walker.trip)
        walker.stuck_time = 0.0
    wanted = _wanted_direction(walker)
    others = [other for other in crowd.near(walker.position) if other is not walker]
    walker.velocity = _choose_velocity(walker, wanted, others, people)
    crowd.move(number, walker.position + _DECISION_INTERVAL * walker.velocity)
    slow = np.linalg.norm(walker.velocity) < 0.3 * walker.speed
    walker.stuck_time = walker.stuck_time + _DECISION_INTERVAL if slow else 0.0


def _next_goal(walker: _Walker, rng: np.random.Generator) -> Array:
    if len(walker.stations) == 0 or walker.stuck_time > _MAX_STUCK_TIME:
        if np.isfinite(walker.trip):
            return walker.free_space.random_place_near(walker.position, walker.trip, rng)
        return walker.free_space.random_place(rng)
    walker.visited += 1
    station = walker.stations[walker.visited % len(walker.stations)]
    return np.asarray(station + rng.uniform(-0.7, 0.7, 2))


def _wanted_direction(walker: _Walker) -> Array:
    """(2,) unit vector towards the farthest part of the path in line of sight, which cuts the cells' corners."""
    nearest = int(np.argmin(np.linalg.norm(walker.path - walker.position, axis=1)))
    walker.path = walker.path[nearest:]
    ahead = walker.path[np.minimum(np.array([2, 4, 6, 9, 12, 16, 20]), len(walker.path) - 1)]
    between = walker.position + np.linspace(0.1, 1, 12)[:, None, None] * (ahead - walker.position)
    cells = walker.free_space.cells(between)
    in_sight = walker.free_space.free[cells[..., 0], cells[..., 1]].all(axis=0)
    target = ahead[np.flatnonzero(in_sight)[-1]] if in_sight.any() else ahead[0]
    step = target - walker.position
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def _choose_velocity(walker: _Walker, wanted: Array, others: Sequence[_Walker], people: PeopleOptions) -> Array:
    """(2,) the velocity of least cost among turns and speeds about the wanted one, and standing, m/s."""
    c, s = np.cos(_CANDIDATE_TURNS), np.sin(_CANDIDATE_TURNS)
    directions = np.stack([c * wanted[0] - s * wanted[1], s * wanted[0] + c * wanted[1]], axis=-1)
    candidates = np.concatenate(
        [(walker.speed * _CANDIDATE_SPEEDS[:, None, None] * directions).reshape(-1, 2), np.zeros((1, 2))]
    )
    cost = np.linalg.norm(candidates - walker.speed * wanted, axis=1)
    cost += 0.8 * np.linalg.norm(candidates - walker.velocity, axis=1)
    ahead = walker.position + _LOOKAHEAD_TIMES[:, None, None] * candidates
    cost[-1] += _STANDING_COST * walker.speed
    free_space = walker.free_space
    blocked = free_space.clearance_at(ahead) < walker.reach + people.clearance
    now_room = free_space.clearance_at(walker.position[None])[0]
    forbidden = blocked[0] & (free_space.clearance_at(ahead[0]) <= now_room)
    cost += walker.speed * (_WALL_COSTS[:, None] * blocked).max(axis=0)
    for other in others:
        if np.linalg.norm(other.position - walker.position) > _HEEDED_DISTANCE:
            continue
        gaps = np.linalg.norm(ahead - other.position - _LOOKAHEAD_TIMES[:, None, None] * other.velocity, axis=-1)
        distance = _min_center_distance(people, walker.reach + other.reach)
        meets = gaps < distance + 0.1
        cost += walker.speed * (_PEOPLE_COSTS[:, None] * meets).max(axis=0)
        # A walker who is too near to another may move away, but not closer.
        here = np.linalg.norm(other.position - walker.position)
        after = np.linalg.norm(ahead[0] - other.position, axis=-1)
        forbidden |= (after < distance) & (after < here)
    forbidden[-1] = False
    return np.asarray(candidates[np.argmin(np.where(forbidden, np.inf, cost))])


def _smooth_walk(axes: Array, places: Array, start: float) -> SimulatedWalk:
    """Resamples and smooths the positions (steps, 2) of every tenth of a second."""
    coarse = _DECISION_INTERVAL * np.arange(len(places))
    fine = SAMPLE_INTERVAL * np.arange(round(coarse[-1] / SAMPLE_INTERVAL) + 1)
    dense = np.stack([np.interp(fine, coarse, places[:, k]) for k in (0, 1)], axis=-1)
    smooth = gaussian_filter1d(dense, _SMOOTHING_SIGMA / SAMPLE_INTERVAL, axis=0, mode="nearest")
    return SimulatedWalk(axes, start, smooth, _headings(np.gradient(smooth, SAMPLE_INTERVAL, axis=0)))


def _headings(velocities: Array) -> Array:
    """Headings (K,) of the walk, constant while standing and smoothed, unwrapped, rad."""
    moving = np.linalg.norm(velocities, axis=1) > 0.2
    if not moving.any():
        return np.zeros(len(velocities))
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(velocities)), np.argmax(moving)))
    angles = np.unwrap(np.arctan2(velocities[latest, 1], velocities[latest, 0]))
    return np.asarray(gaussian_filter1d(angles, _SMOOTHING_SIGMA / SAMPLE_INTERVAL, mode="nearest"))

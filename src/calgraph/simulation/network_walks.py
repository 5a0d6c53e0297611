"""How people walk through a building: around walls and each other, from place to place, with stops.

Each person follows the shortest way to the next place. Ten times a second each chooses the velocity that keeps to
it best without meeting anything within the next second and a half, as in velocity-obstacle crowd models (Fiorini
and Shiller, 1998). The places are then smoothed in time, and the body turns with the walk.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation.network_floor import Ways
from calgraph.simulation.network_scenario import PeopleKnobs

_STEP = 0.1
"""Time between two choices of a velocity, s."""
SAMPLE = 0.01
"""Time between two samples of a walk, s: chords of a walk are within 0.1 mm of it."""
_SMOOTH = 0.25
"""Standard deviation of the filter that places are smoothed with, s."""
_LOOK_AHEAD = np.array([0.1, 0.4, 0.8, 1.2, 1.6])
"""Times at which a velocity is checked for what it leads into, s."""
_BEFORE_PEOPLE = 4.0 * (1 - _LOOK_AHEAD / 2)
"""What meeting someone at those times costs, as a fraction of the speed: the more the sooner."""
_BEFORE_WALLS = np.array([3.0, 1.0, 0.3, 0.0, 0.0])
"""Likewise for walls, which the way leads around farther on."""
_STANDING = 0.5
"""Likewise what standing costs, so that nobody rests before a bend."""
_TURNS = np.radians([0, -15, 15, -30, 30, -50, 50, -75, 75, -105, 105, -150, 150])
_PACES = np.array([1.0, 0.7, 0.35])
_ARRIVED = 0.5
"""m."""
_PATIENCE = 2.5
"""How long one who gets nowhere keeps to a goal, s."""
_SLACK = 0.12
"""What smoothing may move a place by, m; planned on top of the clearance."""


@dataclass(frozen=True, eq=False)
class Walk:
    """One body over time."""

    axes: Array
    """(2,) radii across and along its heading, m."""
    start: float
    """Time of the first sample, s from the start of the recording; nobody is there before."""
    places: Array
    """(K, 2) centre at every hundredth of a second, m."""
    headings: Array
    """(K,) direction it faces, rad, unwrapped."""

    def at(self, times: Array) -> tuple[Array, Array]:
        """Centres (..., 2) and headings (...) at times (...), s; NaN before it comes and after its last sample."""
        sample = (times - self.start) / SAMPLE
        there = (sample >= 0) & (sample <= len(self.places) - 1)
        first = np.clip(np.floor(np.where(there, sample, 0)).astype(np.intp), 0, len(self.places) - 2)
        part = np.where(there, sample - first, np.nan)
        places = self.places[first] + part[..., None] * (self.places[first + 1] - self.places[first])
        return places, self.headings[first] + part * (self.headings[first + 1] - self.headings[first])


@dataclass
class _Walker:
    """One person while its walk is being made."""

    axes: Array
    speed: float
    stations: Array
    """(K, 2) in the order of its visits, or none."""
    place: Array
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    way: Array = field(default_factory=lambda: np.zeros((0, 2)))
    visited: int = 0
    stopped_until: float = 0.0
    stuck: float = 0.0


def body_clearance(people: PeopleKnobs) -> float:
    """How far a body's centre is planned to stay from walls, m."""
    return people.reach + people.clearance + _SLACK


def draw_walks(
    ways: Ways, stations: Array, people: PeopleKnobs, start: float, end: float, rng: np.random.Generator
) -> tuple[Walk, ...]:
    """Walks of all people from a start to an end, s.

    Args:
        ways: where they may walk.
        stations: (K, 2) places they visit one after the other, each person from another one on and in either
            direction; with none they walk to random places.
        people: how many, how fast, how large.
        start: s from the start of the recording.
        end: s.
        rng: draws everything random.

    Raises:
        InputError: there is no place for so many.

    """
    walkers = _set_out(ways, stations, people, rng)
    steps = int(np.ceil((end - start) / _STEP)) + 2
    places = np.empty((steps, len(walkers), 2))
    for step in range(steps):
        for walker in walkers:
            _advance(walker, walkers, ways, people, step * _STEP, rng)
        for k, walker in enumerate(walkers):
            places[step, k] = walker.place
    return tuple(_walk(walker.axes, places[:, k], start) for k, walker in enumerate(walkers))


def _set_out(ways: Ways, stations: Array, people: PeopleKnobs, rng: np.random.Generator) -> list[_Walker]:
    walkers: list[_Walker] = []
    for k in range(people.count):
        own = 1 + rng.uniform(-people.axes_spread, people.axes_spread, 2)
        axes = np.full(2, people.diameter / 2) if people.kind == "cylinder" else own * people.axes
        order = np.roll(stations, -round(k * len(stations) / max(people.count, 1)), axis=0)
        if len(order) and rng.random() < 0.5:
            order = np.roll(order[::-1], 1, axis=0)
        place = ways.nearest(order[0]) if len(order) else ways.random_place(rng)
        for _ in range(100):
            if all(np.linalg.norm(place - other.place) > _apart(people) + 0.2 for other in walkers):
                break
            place = ways.random_place(rng)
        else:
            raise InputError(f"people.count: {people.count} do not fit on the floor, only {len(walkers)} do")
        speed = people.speed * (1 + rng.uniform(-people.speed_spread, people.speed_spread))
        walkers.append(_Walker(axes, speed, order, place))
    return walkers


def _apart(people: PeopleKnobs) -> float:
    """The least distance of two centres, m."""
    return 2 * people.reach + people.clearance + _SLACK


def _advance(
    walker: _Walker,
    all_of_them: Sequence[_Walker],
    ways: Ways,
    people: PeopleKnobs,
    now: float,
    rng: np.random.Generator,
) -> None:
    """Moves one person on by a step."""
    if now < walker.stopped_until:
        walker.velocity = np.zeros(2)
        return
    if people.stop_every > 0 and rng.random() < _STEP / people.stop_every:
        walker.stopped_until = now + rng.exponential(people.stop_time)
    if (
        len(walker.way) == 0
        or walker.stuck > _PATIENCE
        or np.linalg.norm(walker.way[-1] - walker.place) < _ARRIVED
    ):
        walker.way, walker.stuck = ways.way(walker.place, _next_goal(walker, ways, rng)), 0.0
    wanted = _direction(walker, ways)
    others = [other for other in all_of_them if other is not walker]
    walker.velocity = _choose(walker, wanted, others, ways, people)
    walker.place = walker.place + _STEP * walker.velocity
    slow = np.linalg.norm(walker.velocity) < 0.3 * walker.speed
    walker.stuck = walker.stuck + _STEP if slow else 0.0


def _next_goal(walker: _Walker, ways: Ways, rng: np.random.Generator) -> Array:
    if len(walker.stations) == 0 or walker.stuck > _PATIENCE:
        return ways.random_place(rng)
    walker.visited += 1
    station = walker.stations[walker.visited % len(walker.stations)]
    return np.asarray(station + rng.uniform(-0.7, 0.7, 2))


def _direction(walker: _Walker, ways: Ways) -> Array:
    """(2,) unit vector towards the farthest part of the way that one sees, which cuts the corners of the cells."""
    nearest = int(np.argmin(np.linalg.norm(walker.way - walker.place, axis=1)))
    walker.way = walker.way[nearest:]
    ahead = walker.way[np.minimum(np.array([2, 4, 6, 9, 12, 16, 20]), len(walker.way) - 1)]
    between = walker.place + np.linspace(0.1, 1, 12)[:, None, None] * (ahead - walker.place)
    cells = ways.cells(between)
    seen = ways.free[cells[..., 0], cells[..., 1]].all(axis=0)
    target = ahead[np.flatnonzero(seen)[-1]] if seen.any() else ahead[0]
    step = target - walker.place
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def _choose(walker: _Walker, wanted: Array, others: Sequence[_Walker], ways: Ways, people: PeopleKnobs) -> Array:
    """(2,) the best velocity among turns and paces off the wanted one, and standing still, m/s."""
    c, s = np.cos(_TURNS), np.sin(_TURNS)
    directions = np.stack([c * wanted[0] - s * wanted[1], s * wanted[0] + c * wanted[1]], axis=-1)
    candidates = np.concatenate(
        [(walker.speed * _PACES[:, None, None] * directions).reshape(-1, 2), np.zeros((1, 2))]
    )
    cost = np.linalg.norm(candidates - walker.speed * wanted, axis=1)
    cost += 0.8 * np.linalg.norm(candidates - walker.velocity, axis=1)
    ahead = walker.place + _LOOK_AHEAD[:, None, None] * candidates
    cost[-1] += _STANDING * walker.speed
    blocked = ways.room(ahead) < people.reach + people.clearance
    now_room = ways.room(walker.place[None])[0]
    forbidden = blocked[0] & (ways.room(ahead[0]) <= now_room)
    cost += walker.speed * (_BEFORE_WALLS[:, None] * blocked).max(axis=0)
    for other in others:
        if np.linalg.norm(other.place - walker.place) > 6:
            continue
        gaps = np.linalg.norm(ahead - other.place - _LOOK_AHEAD[:, None, None] * other.velocity, axis=-1)
        meets = gaps < _apart(people) + 0.1
        cost += walker.speed * (_BEFORE_PEOPLE[:, None] * meets).max(axis=0)
        # One may step away from whom one is too near to, but not closer.
        here = np.linalg.norm(other.place - walker.place)
        after = np.linalg.norm(ahead[0] - other.place, axis=-1)
        forbidden |= (after < _apart(people)) & (after < here)
    forbidden[-1] = False
    return np.asarray(candidates[np.argmin(np.where(forbidden, np.inf, cost))])


def _walk(axes: Array, places: Array, start: float) -> Walk:
    """A smooth walk through the places (steps, 2) of every tenth of a second."""
    coarse = _STEP * np.arange(len(places))
    fine = SAMPLE * np.arange(round(coarse[-1] / SAMPLE) + 1)
    dense = np.stack([np.interp(fine, coarse, places[:, k]) for k in (0, 1)], axis=-1)
    smooth = gaussian_filter1d(dense, _SMOOTH / SAMPLE, axis=0, mode="nearest")
    return Walk(axes, start, smooth, _headings(np.gradient(smooth, SAMPLE, axis=0)))


def _headings(velocities: Array) -> Array:
    """Directions (K,) of the walk, held while standing and turned smoothly, unwrapped, rad."""
    moving = np.linalg.norm(velocities, axis=1) > 0.2
    if not moving.any():
        return np.zeros(len(velocities))
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(velocities)), np.argmax(moving)))
    angles = np.unwrap(np.arctan2(velocities[latest, 1], velocities[latest, 0]))
    return np.asarray(gaussian_filter1d(angles, _SMOOTH / SAMPLE, mode="nearest"))

"""Disturbances in a building: chairs that are moved sometimes, and mirrors on walls."""

from collections.abc import Sequence

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation.network_floor import Floor, polygon_sides, rectangle
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, SimulatedWalk

_TRIES = 500
"""Random places that are tried for each chair or mirror."""
_SEAT = 0.42
"""Edge of a chair, m."""
_CHAIR_LEG_RADII = np.array([0.015, 0.015])
"""m."""
_ROAMING_RADIUS = 0.25
"""Largest distance of a chair from the middle of its places, m."""
CHAIR_REACH = _ROAMING_RADIUS + _SEAT / np.sqrt(2)
"""Of a chair in any of its places from their middle, m."""
_MOVE_EVERY, _MOVE_TIME = 20.0, 1.5
"""Mean time from one move of a chair to the next, and how long it takes, s."""
_CHAIR_DISTANCE = 1.5
"""Minimum distance of chairs from each other, from scanners and from stations, m."""
_MIRROR_WIDTH = 2.0
"""m."""
_MIRROR_OFFSET = 0.02
"""Distance of a mirror from the wall behind it, m."""
_MIRROR_CLEARANCE = 1.0
"""Minimum distance of a mirror's middle from scanners, m."""


def place_chairs(floor: Floor, count: int, others: Array, rng: np.random.Generator) -> Array:
    """(H, 2) middles of the places of up to ``count`` chairs, away from walls and from ``others`` (N, 2), m."""
    low, high = floor.outline.min(axis=0), floor.outline.max(axis=0)
    tries = rng.uniform(low, high, (_TRIES if count else 0, 2))
    places = list[Array]()
    for place in tries[floor.clearance(tries) > CHAIR_REACH]:
        near = np.linalg.norm(np.concatenate([others, np.reshape(places, (-1, 2))]) - place, axis=1)
        if len(places) < count and near.min(initial=np.inf) > _CHAIR_DISTANCE:
            places.append(place)
    return np.reshape(places, (-1, 2))


def move_chairs(homes: Array, duration: float, solid: bool, rng: np.random.Generator) -> tuple[SimulatedWalk, ...]:
    """What beams hit of chairs.

    Args:
        homes: (H, 2) middles of their places, m.
        duration: s.
        solid: a closed square, as at the height of the seat, or four legs.
        rng: draws when and where they move.
    """
    return tuple(part for home in homes for part in _move_chair(home, duration, solid, rng))


def place_mirrors(floor: Floor, count: int, scanners: Array, rng: np.random.Generator) -> Array:
    """(Q, 2, 2) end points of mirrors on outer walls, away from scanners (N, 2), m.

    Raises:
        InputError: there is no place for them.
    """
    sides = polygon_sides(floor.outline)
    along = sides[:, 1] - sides[:, 0]
    lengths = np.linalg.norm(along, axis=1)
    mirrors = list[Array]()
    for _ in range(_TRIES if count else 0):
        k = int(rng.choice(len(sides), p=lengths / lengths.sum()))
        unit = along[k] / lengths[k]
        inwards = np.array([-unit[1], unit[0]])
        middle = sides[k, 0] + rng.uniform(0, lengths[k]) * unit + _MIRROR_OFFSET * inwards
        ends = middle + np.outer([-0.5, 0.5], _MIRROR_WIDTH * unit)
        inside = floor.clearance(ends).min() > _MIRROR_OFFSET / 2
        taken = np.concatenate([np.reshape([m.mean(axis=0) for m in mirrors], (-1, 2)), scanners])
        distances = np.array([_MIRROR_WIDTH] * len(mirrors) + [_MIRROR_CLEARANCE] * len(scanners))
        if inside and (np.linalg.norm(taken - middle, axis=1) > distances).all():
            mirrors.append(ends)
        if len(mirrors) == count:
            break
    if len(mirrors) < count:
        raise InputError(f"mirrors: {count} do not fit on the walls, only {len(mirrors)} do")
    return np.reshape(mirrors, (-1, 2, 2))


def _move_chair(home: Array, duration: float, solid: bool, rng: np.random.Generator) -> Sequence[SimulatedWalk]:
    """The parts of one chair."""
    times = SAMPLE_INTERVAL * np.arange(round(duration / SAMPLE_INTERVAL) + 2)
    poses = np.tile(_draw_place(home, rng), (len(times), 1))
    begin = rng.exponential(_MOVE_EVERY)
    while begin < duration:
        share = np.clip((times - begin) / _MOVE_TIME, 0, 1)
        target = _draw_place(home, rng)
        poses += (share * share * (3 - 2 * share))[:, None] * (target - poses[-1])
        begin += _MOVE_TIME + rng.exponential(_MOVE_EVERY)
    places, headings = poses[:, :2], poses[:, 2]
    if solid:
        outline = rectangle((0.0, 0.0), (_SEAT, _SEAT))
        return [SimulatedWalk(np.full(2, _SEAT / 2), 0.0, places, headings, outline)]
    c, s = np.cos(headings), np.sin(headings)
    corners = rectangle((0.0, 0.0), (_SEAT, _SEAT))
    offsets = [np.stack([x * c - y * s, x * s + y * c], axis=-1) for x, y in corners]
    return [SimulatedWalk(_CHAIR_LEG_RADII, 0.0, places + offset, headings) for offset in offsets]


def _draw_place(home: Array, rng: np.random.Generator) -> Array:
    """(3,) x, y, m, and heading, rad, of a chair."""
    angle, radius = rng.uniform(-np.pi, np.pi), _ROAMING_RADIUS * np.sqrt(rng.random())
    return np.array([*(home + radius * np.array([np.cos(angle), np.sin(angle)])), rng.uniform(-np.pi, np.pi)])

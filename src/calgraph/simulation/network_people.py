"""Who walks together, and what beams hit of them: torsos with arms, legs, skirts, and carts that they push.

People come in the order couples, those who push carts, those who push trolleys, all others; the last ones wear
skirts.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_floor import FreeSpace, rectangle
from calgraph.simulation.network_legs import add_legs, draw_gait
from calgraph.simulation.network_scenario import NetworkScenario, PeopleOptions
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, Party, SimulatedWalk

_COUPLE_DISTANCE = 0.62
"""Between two people side by side, m."""
_COUPLE_WOBBLE = np.array([0.1, 0.05])
"""Amplitude of the motion of one relative to the other along and across the walk, m."""
_WOBBLE_PERIODS = np.array([7.0, 5.0])
"""s."""
_PUSHING_REACH = 0.6
"""Radius kept free around a person with a cart, m; corners of the cart may touch walls on bends."""
_PERSON_BEHIND, _CART_AHEAD = 0.5, 0.45
"""Distances of the person and of the cart from the middle of both, m: legs do not step into the cart."""
_CART_SIZE, _TROLLEY_SIZE = (0.8, 0.5), (0.7, 0.45)
"""Length and width, m."""
_POLE_RADII = np.array([0.015, 0.015])
"""m."""
_SKIRT_SWAY = 0.5
"""Share of the motion of the legs' middle that a skirt has."""


def party_reaches(people: PeopleOptions) -> list[float]:
    """The radius that each party keeps free, m; parties are in the order of people."""
    single, couple = people.reach, people.reach + _COUPLE_DISTANCE / 2
    pushing = people.carts + people.trolleys
    others = people.count - 2 * people.couples - pushing
    return [couple] * people.couples + [_PUSHING_REACH] * pushing + [single] * others


def form_parties(people: PeopleOptions, find_space: Callable[[float], FreeSpace]) -> list[Party]:
    """All parties; ``find_space`` gives the free space of a reach."""
    reaches = party_reaches(people)
    spaces = {reach: find_space(reach) for reach in set(reaches)}
    return [Party(reach, spaces[reach]) for reach in reaches]


def separate_people(
    people: PeopleOptions, parties: Sequence[SimulatedWalk], rng: np.random.Generator
) -> tuple[SimulatedWalk, ...]:
    """The walks of all people, from the walks of the parties."""
    walks: list[SimulatedWalk] = []
    pushing = range(people.couples, people.couples + people.carts + people.trolleys)
    for k, party in enumerate(parties):
        if k < people.couples:
            walks += _separate_couple(people, party, rng)
        elif k in pushing:
            walks.append(_shift(party, -_PERSON_BEHIND, 0.0))
        else:
            walks.append(party)
    return tuple(walks)


def build_bodies(
    scenario: NetworkScenario, walks: Sequence[SimulatedWalk], seed: int
) -> tuple[SimulatedWalk, ...]:
    """What beams hit of people with these walks."""
    people = scenario.people
    carts = range(2 * people.couples, 2 * people.couples + people.carts)
    trolleys = range(carts.stop, carts.stop + people.trolleys)
    bodies: list[SimulatedWalk] = []
    for k, walk in enumerate(walks):
        if people.shape == "ellipse":
            bodies += add_arms(walk, people.swing)
        else:
            gait = draw_gait(people, np.random.default_rng((seed, 0, k + 1)))
            left, right = add_legs(walk, gait, scenario.scanner.height)
            bodies += [_cover(walk, left, right, people)] if k >= people.count - people.skirts else [left, right]
        if k in carts:
            bodies.append(_push_cart(walk))
        elif k in trolleys:
            bodies += _push_trolley(walk)
    return tuple(bodies)


def _separate_couple(
    people: PeopleOptions, party: SimulatedWalk, rng: np.random.Generator
) -> tuple[SimulatedWalk, SimulatedWalk]:
    time = SAMPLE_INTERVAL * np.arange(len(party.positions))[:, None]
    phases = rng.uniform(0, 2 * np.pi, 2)
    ahead, aside = (_COUPLE_WOBBLE * np.sin(2 * np.pi * time / _WOBBLE_PERIODS + phases) / 2).T
    scale = 1 + rng.uniform(-people.axes_spread, people.axes_spread, 2)
    left = _shift(party, ahead, _COUPLE_DISTANCE / 2 + aside)
    right = _shift(party, -ahead, -_COUPLE_DISTANCE / 2 - aside)
    return left, replace(right, axes=scale * people.axes)


def _shift(walk: SimulatedWalk, ahead: Array | float, left: Array | float) -> SimulatedWalk:
    """A body with the same heading that is ``ahead`` and to the ``left``, m, each one number or (K,)."""
    c, s = np.cos(walk.headings), np.sin(walk.headings)
    offset = np.stack([ahead * c - left * s, ahead * s + left * c], axis=-1)
    return replace(walk, positions=walk.positions + offset)


def _cover(walk: SimulatedWalk, left: SimulatedWalk, right: SimulatedWalk, people: PeopleOptions) -> SimulatedWalk:
    """A skirt, which follows the pelvis and the legs."""
    middle = (left.positions + right.positions) / 2
    positions = walk.positions + _SKIRT_SWAY * (middle - walk.positions)
    return replace(walk, axes=np.array(people.skirt_radii) * walk.axes / people.axes, positions=positions)


def _push_cart(walk: SimulatedWalk) -> SimulatedWalk:
    cart = _shift(walk, _PERSON_BEHIND + _CART_AHEAD, 0.0)
    return replace(cart, axes=np.array(_CART_SIZE[::-1]) / 2, outline=rectangle((0.0, 0.0), _CART_SIZE))


def _push_trolley(walk: SimulatedWalk) -> list[SimulatedWalk]:
    length, width = _TROLLEY_SIZE
    ahead = _PERSON_BEHIND + _CART_AHEAD
    poles = [(ahead + x * length / 2, y * width / 2) for x in (-1, 1) for y in (-1, 1)]
    return [replace(_shift(walk, x, y), axes=_POLE_RADII) for x, y in poles]


_STRIDE_LENGTH = 1.33
"""Length of a stride, two steps, m: 0.9 strides a second at 1.2 m/s."""
_FULL_SWING_SPEED = 0.8
"""Minimum speed of the full swing, m/s; below it the swing is proportional to the speed."""
_ARM_RADII = np.array([0.045, 0.06])
"""Radii of an arm, across and along the heading, m."""
_SHOULDER_TWIST = 0.3
"""Turn of the shoulders per swing of the arms, rad/m."""


def add_arms(walk: SimulatedWalk, swing: float) -> tuple[SimulatedWalk, ...]:
    """Adds both arms to the torso of a walking person; the walk alone if the swing is 0.

    Args:
        walk: of the torso, before it twists.
        swing: amplitude of the arms, m.
    """
    if swing == 0:
        return (walk,)
    speed = np.linalg.norm(np.gradient(walk.positions, SAMPLE_INTERVAL, axis=0), axis=1)
    phase = 2 * np.pi / _STRIDE_LENGTH * SAMPLE_INTERVAL * np.cumsum(speed)
    forward = swing * np.minimum(speed / _FULL_SWING_SPEED, 1) * np.sin(phase)
    torso = replace(walk, headings=walk.headings - _SHOULDER_TWIST * forward)
    return torso, _build_arm(torso, 1.0, forward), _build_arm(torso, -1.0, -forward)


def _build_arm(torso: SimulatedWalk, side: float, forward: Array) -> SimulatedWalk:
    """The arm on the left (1) or right (-1), ``forward`` (K,) of its shoulder, m."""
    c, s = np.cos(torso.headings), np.sin(torso.headings)
    ahead, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    positions = torso.positions + side * torso.axes[0] * left + forward[:, None] * ahead
    return replace(torso, axes=_ARM_RADII, positions=positions)

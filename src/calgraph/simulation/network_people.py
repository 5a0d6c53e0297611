"""Who walks together, and what beams hit of them: torsos with arms, legs, skirts, and carts that they push.

People come in the order couples, those who push carts, those who push trolleys, all others; the last ones wear
skirts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.special import betainc

from calgraph.geometry import Array
from calgraph.simulation.network_floor import FreeSpace, rectangle
from calgraph.simulation.network_scenario import NetworkScenario, PeopleOptions
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, Party, Section, SimulatedWalk

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


ANKLE_HEIGHT, KNEE_HEIGHT, HIP_HEIGHT = 0.09, 0.5, 0.9
"""Heights of the joints of a person of 1.75 m, m."""
_USUAL_SPEED = 1.2
"""Speed at which people's steps have the stated length, m/s."""
_LENGTH_EXPONENT = 0.5
"""Steps are longer at higher speeds by this power, and cadence rises likewise."""
_MAX_STEP_TIME = 0.8
"""Of slow walks, s."""
_STEP_LENGTH_SPREAD = 0.08
"""Largest relative difference of a person's step length."""
_MOTION_TIME = 1.2
"""Time from the rise of the heel to the next rest of the ankle, in step times; a stride has two."""
_REST_CENTRE = 1.6
"""Middle of the rest that follows, in step times from the rise of the heel."""
_SWING_PROFILE = 4.0, 3.0
"""Exponents of the beta distribution of which the progress of a swing is the integral: peaks at 4 m/s, late."""
_PLANNING_TIME = 0.6
"""Time ahead over which the speed of the next step is averaged, s."""
_STANDING_SPEED = 0.2
"""Below this speed feet are put side by side, m/s."""
_STANDING_TOLERANCE = 0.04
"""A foot this near to its place beside the other one stays there, m."""
_DECISION_INTERVAL = 0.05
"""Time between two decisions of a person who stands, s."""
_KNEE_SHARE = 0.7
"""Share of the hip's motion over a resting foot that the knee has."""
_KNEE_BEND = 0.12
"""How far the knee moves forwards in swing, m."""
_TOE_OUT = np.radians((3.0, 10.0))
"""Range of the outward rotation of feet, rad."""
_MIN_LEG_GAP = 0.004
"""Minimum distance of two legs side by side, m."""
_LEAD_SAMPLES = 12
"""Samples of a walk over which a leg is led around the other."""
_FLATTENING = 0.88
"""Where the front is cut off, over the half depth; real shins have 58 mm of half width and a radius of
curvature of 86 to 115 mm."""
_CORNERS = 72
"""Of the polygon that approximates a cross section: within 0.1 mm."""
_SIDES = 1.0, -1.0
"""Left and right."""
_PROFILE_HEIGHTS = np.array([0.0, 0.09, 0.2, 0.33, 0.45, 0.5, 0.75])
_PROFILE_SIZES = np.array([0.7, 0.62, 0.8, 1.0, 0.93, 0.95, 1.35])
"""Size of a leg over that of the calf, by height in m: ankle, calf, knee, thigh."""

_SECTION_HEIGHTS = np.array([0.0, ANKLE_HEIGHT, 0.2, 0.33, 0.45, KNEE_HEIGHT, 0.75, HIP_HEIGHT])
"""Between which a leg is straight and its size changes evenly, m."""


@dataclass(frozen=True)
class Gait:
    """How one person walks, and the legs."""

    step_length: float
    """At 1.2 m/s, m."""
    foot_offset: float
    """Distance of each foot from the centre line, m."""
    toe_out: float
    """Outward rotation of the feet, rad."""
    radii: tuple[float, float]
    """Half width and half depth of the calf, m."""
    squareness: float
    """Exponent of the superellipse."""


@dataclass
class _Footsteps:
    """Of one foot, in order."""

    times: list[float] = field(default_factory=list)
    """When the heel rises, s."""
    durations: list[float] = field(default_factory=list)
    """Until the next rest, s."""
    poses: list[Array] = field(default_factory=list)
    """(3,) x, y, heading: the first place, then where each step ends; one more than there are steps."""

    def sample(self, times: Array) -> tuple[Array, Array]:
        """Poses (K, 3) of the foot at times (K,), and the progress (K,) of its step, 0 or 1 at rest."""
        poses = np.array(self.poses)
        step = np.searchsorted(self.times, times, side="right") - 1
        started = np.array([-np.inf, *self.times])[step + 1]
        progress = np.minimum((times - started) / np.array([1.0, *self.durations])[step + 1], 1.0)
        share = betainc(*_SWING_PROFILE, progress)[:, None]
        start, end = poses[np.maximum(step, 0)], poses[step + 1]
        return start + share * (end - start), progress


def draw_gait(people: PeopleOptions, rng: np.random.Generator) -> Gait:
    """Draws the gait of one person."""
    width, depth = (1 + rng.uniform(-people.leg_spread, people.leg_spread, 2)) * people.leg_radii
    low, high = people.foot_offset
    return Gait(
        step_length=people.step_length * (1 + rng.uniform(-_STEP_LENGTH_SPREAD, _STEP_LENGTH_SPREAD)),
        foot_offset=max(float(rng.uniform(low, high)), width + _MIN_LEG_GAP / 2),
        toe_out=float(rng.uniform(*_TOE_OUT)),
        radii=(float(width), float(depth)),
        squareness=people.leg_squareness,
    )


def add_legs(walk: SimulatedWalk, gait: Gait, height: float) -> tuple[SimulatedWalk, SimulatedWalk]:
    """The left and the right leg of a walking person, as cut by a horizontal scan plane.

    Args:
        walk: of the pelvis.
        gait: of the person.
        height: of the scan plane above the floor, m.
    """
    times: Array = SAMPLE_INTERVAL * np.arange(len(walk.positions), dtype=np.float64)
    outline = leg_size(height) * shin_outline(*gait.radii, gait.squareness)
    pelvis = np.column_stack([walk.positions, walk.headings])
    feet = [steps.sample(times) for steps in _plan_steps(pelvis, gait)]
    hips = [_beside(pelvis, side * gait.foot_offset)[:, :2] for side in _SIDES]
    swings = [np.sin(np.pi * progress) ** 2 for _, progress in feet]

    def cut(at: float) -> tuple[Array, Array]:
        left, right = (
            _center_at(at, foot, hip, swing) for (foot, _), hip, swing in zip(feet, hips, swings, strict=True)
        )
        size = leg_size(at) * np.array(gait.radii)
        return _keep_apart(left, right, walk.headings, size, swings[0], swings[1])

    centers = cut(height)
    cuts = [cut(at) for at in _SECTION_HEIGHTS.tolist()]
    sizes = np.array([leg_size(at) / leg_size(height) for at in _SECTION_HEIGHTS.tolist()])
    legs = []
    for k, side in enumerate(_SIDES):
        offsets = np.array([one[k] - centers[k] for one in cuts])
        legs.append(
            SimulatedWalk(
                leg_size(height) * np.array(gait.radii),
                walk.start,
                centers[k],
                feet[k][0][:, 2] + side * gait.toe_out,
                outline,
                Section(height, _SECTION_HEIGHTS, offsets, sizes),
            )
        )
    return legs[0], legs[1]


def _center_at(height: float, feet: Array, hip: Array, swing: Array) -> Array:
    """(K, 2) centre of a leg at a height, for poses (K, 3) of the foot and positions (K, 2) of the hip."""
    ankle, heading = feet[:, :2], feet[:, 2]
    bend = _KNEE_BEND * swing[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    knee = ankle + _KNEE_SHARE * (hip - ankle) + bend
    if height <= KNEE_HEIGHT:
        return np.asarray(ankle + (height - ANKLE_HEIGHT) / (KNEE_HEIGHT - ANKLE_HEIGHT) * (knee - ankle))
    return np.asarray(knee + (height - KNEE_HEIGHT) / (HIP_HEIGHT - KNEE_HEIGHT) * (hip - knee))


def _keep_apart(
    left: Array, right: Array, headings: Array, extent: Array, left_swing: Array, right_swing: Array
) -> tuple[Array, Array]:
    """Centres (K, 2) of both legs, the swinging one led around the other where they would touch on a bend."""
    forwards = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    leftwards = np.stack([-forwards[:, 1], forwards[:, 0]], axis=-1)
    ahead, aside = ((left - right) * forwards).sum(axis=1), ((left - right) * leftwards).sum(axis=1)
    # The centre of one leg stays out of an ellipse of twice the size about the other.
    width, depth = 2 * extent + _MIN_LEG_GAP
    wanted = width * np.sqrt(np.maximum(1 - (ahead / depth) ** 2, 0))
    lead = np.where(wanted > 0, np.maximum(wanted - aside, 0), 0)
    lead = gaussian_filter1d(maximum_filter1d(lead, _LEAD_SAMPLES), _LEAD_SAMPLES / 4)[:, None] * leftwards
    share = ((left_swing + 1e-3) / (left_swing + right_swing + 2e-3))[:, None]
    return left + share * lead, right - (1 - share) * lead


def leg_size(height: float) -> float:
    """Size of a leg's cross section at a height (m) over that of the calf."""
    return float(np.interp(height, _PROFILE_HEIGHTS, _PROFILE_SIZES))


def shin_outline(half_width: float, half_depth: float, squareness: float) -> Array:
    """(K, 2) corners of the cross section of a shin that faces x, counter-clockwise and convex, m."""
    angle = 2 * np.pi * (np.arange(_CORNERS) + 0.5) / _CORNERS
    c, s = np.cos(angle), np.sin(angle)
    x = np.minimum(np.sign(c) * np.abs(c) ** (2 / squareness), _FLATTENING)
    y = half_width * np.sign(s) * np.abs(s) ** (2 / squareness)
    # From -1 to the flat front, stretched to the stated depth about its middle.
    return np.column_stack([half_depth * (2 * x + 1 - _FLATTENING) / (1 + _FLATTENING), y])


def _beside(poses: Array, left: float) -> Array:
    """Poses (..., 3) to the left of poses (..., 3) by ``left``, m."""
    x, y, heading = np.moveaxis(poses, -1, 0)
    return np.stack([x - left * np.sin(heading), y + left * np.cos(heading), heading], axis=-1)


def _plan_steps(pelvis: Array, gait: Gait) -> tuple[_Footsteps, _Footsteps]:
    """Steps of the left and the right foot for poses (K, 3) of the pelvis."""
    end = SAMPLE_INTERVAL * (len(pelvis) - 1)
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pelvis[:, :2], axis=0), axis=1))])

    def sample(time: float) -> int:
        return round(min(max(time, 0.0), end) / SAMPLE_INTERVAL)

    def place(side: int, time: float) -> Array:
        return _beside(pelvis[sample(time)], (gait.foot_offset, -gait.foot_offset)[side])

    def speed(time: float) -> float:
        return float(path[sample(time + _PLANNING_TIME)] - path[sample(time)]) / _PLANNING_TIME

    feet = (_Footsteps(poses=[place(0, 0.0)]), _Footsteps(poses=[place(1, 0.0)]))
    now, side = 0.0, 0
    while now < end:
        pace = speed(now)
        if pace > _STANDING_SPEED:
            length = gait.step_length * (pace / _USUAL_SPEED) ** _LENGTH_EXPONENT
            step_time = min(length / pace, _MAX_STEP_TIME)
            _add_step(feet[side], now, _MOTION_TIME * step_time, place(side, now + _REST_CENTRE * step_time))
            now, side = now + step_time, 1 - side
        else:
            now, side = _stand(feet, now, side, place)
    return feet


def _stand(
    feet: tuple[_Footsteps, _Footsteps], now: float, side: int, place: Callable[[int, float], Array]
) -> tuple[float, int]:
    """Puts a foot beside the other one where it is not yet; the time and foot of the next decision."""
    for foot in (side, 1 - side):
        target = place(foot, now + _MAX_STEP_TIME)
        if np.linalg.norm(feet[foot].poses[-1][:2] - target[:2]) > _STANDING_TOLERANCE:
            _add_step(feet[foot], now, _MAX_STEP_TIME, target)
            return now + _MAX_STEP_TIME, 1 - foot
    return now + _DECISION_INTERVAL, side


def _add_step(foot: _Footsteps, time: float, duration: float, target: Array) -> None:
    foot.times.append(time)
    foot.durations.append(duration)
    foot.poses.append(target)

"""People as scanners below the hip observe them: two legs that walk.

Footholds come from the walk: a foot rests where the pelvis passes in the middle of its stance, beside the path. In
swing the ankle moves from one foothold to the next; the knee moves between ankle and hip and bends in swing. The
shin is straight from ankle to knee, so that what a scanner observes depends on the height of its scan plane. Its
cross section is a superellipse with a flat front, deeper than wide, that turns with the foot.

Proportions are those of gait analysis (Perry and Burnfield, Gait Analysis, 2010; Winter, Biomechanics and Motor
Control of Human Movement, 2009): the ankle rests for 40 % of a stride, the heel rises and the leg swings for 60 %.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.special import betainc

from calgraph.geometry import Array
from calgraph.simulation.network_scenario import PeopleOptions
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, Section, SimulatedWalk

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

"""People in three dimensions: bodies with heads, torsos, arms that swing and legs that step, coats and bags.

Lengths of segments over the stature are those of Drillis and Contini (1966), as in Winter, *Biomechanics and Motor
Control of Human Movement*, 2009, fig. 4.1; sizes of heads and torsos are those of the ANSUR survey of 2012.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calgraph.geometry import Array
from calgraph.simulation.drive_motion import draw_drift
from calgraph.simulation.hall_bodies import Mover, Part, place_box, place_ellipsoid, place_limb
from calgraph.simulation.network_people import ANKLE_HEIGHT, add_legs, draw_gait
from calgraph.simulation.network_scenario import PeopleOptions
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, SimulatedWalk

_ANKLE, _KNEE, _HIP, _WAIST, _SHOULDER, _CHIN = 0.039, 0.285, 0.52, 0.62, 0.81, 0.87
"""Heights over the stature."""
_UPPER_ARM, _FOREARM, _FOOT = 0.186, 0.22, 0.152
"""Lengths over the stature; forearms with hands that are half closed."""
_HALF_SHOULDERS, _HALF_HIPS = 0.115, 0.05
"""Distances of joints from the middle over the stature."""
_REACH = 0.85
"""Of feet, arms and bags from the middle of a body, m."""
_LIFT = 0.1
"""Height to which an ankle is raised in swing, m."""
_FULL_SPEED = 3.5
"""Of an ankle in swing, m/s."""
_BOB = 0.6
"""Share of the fall of the hips, for legs of constant length, that ankles and knees do not take up."""


@dataclass(frozen=True)
class Body:
    """Sizes and habits of one person."""

    stature: float
    """With shoes, m."""
    girth: float
    """Of the torso, over the mean."""
    swing: tuple[float, float]
    """Amplitudes of the left and right arm, rad."""
    bend: tuple[float, float]
    """Of the elbows, rad: 1.6 where a person carries something or looks at a phone."""
    lean: float
    """Forward lean of the torso, rad."""
    gaze: float
    """Downward pitch of the head, rad."""
    coat: bool
    bag: str
    """On the back, at a side, or none."""
    head: tuple[float, float, float]
    """Half length, width and height of the head with hair, m."""
    greys: tuple[float, float, float]
    """Reflectivity of skin, of what is worn above and of what is worn below."""


def draw_body(rng: np.random.Generator) -> Body:
    """Draws a person."""
    carries = rng.random(2) < 0.15
    return Body(
        stature=0.02 + float(np.clip(rng.normal(1.7, 0.09), 1.5, 1.95)),
        girth=float(np.clip(rng.normal(1.05, 0.11), 0.85, 1.4)),
        swing=tuple(np.where(carries, 0.05, rng.uniform(0.2, 0.6) * rng.uniform(0.7, 1.0, 2)).tolist()),
        bend=tuple(np.where(carries, 1.6, rng.uniform(0.15, 0.5, 2)).tolist()),
        lean=float(rng.uniform(0.0, 0.12)),
        gaze=float(rng.choice([rng.uniform(-0.05, 0.2), rng.uniform(0.3, 0.6)], p=[0.8, 0.2])),
        coat=bool(rng.random() < 0.25),
        bag=str(rng.choice(["", "back", "side"], p=[0.6, 0.25, 0.15])),
        head=tuple((np.array([0.1, 0.079, 0.122]) * rng.normal(1.03, 0.04, 3)).tolist()),
        greys=tuple(rng.choice([0.1, 0.3, 0.5, 0.8], 3).tolist()),
    )


def add_person(
    walk: SimulatedWalk, options: PeopleOptions, ground: Callable[[Array], Array], rng: np.random.Generator
) -> Mover:
    """A person who walks.

    Args:
        walk: of the pelvis over the floor.
        options: of the gait.
        ground: height (N,) of the floor at (N, 2), m.
        rng: draws the person.
    """
    body = draw_body(rng)
    joints, yaws = _move_joints(walk, options, body, ground, rng)
    start, last = walk.start, len(walk.positions) - 1

    def interpolate(times: Array) -> tuple[Array, Array]:
        """Joints (J, 3, G) and yaws (3, G) of pelvis, shoulders and head."""
        sample = np.clip((times - start) / SAMPLE_INTERVAL, 0, last - 1e-6)
        first = sample.astype(np.intp)
        part = sample - first
        one, two = joints[..., first], joints[..., first + 1]
        return one + part * (two - one), yaws[:, first] + part * (yaws[:, first + 1] - yaws[:, first])

    def place(times: Array) -> Array:
        found, _ = interpolate(times)
        return np.asarray(np.concatenate([found[_PELVIS, :2], found[_GROUND, 2:]]))

    def parts(times: Array) -> list[Part]:
        return _dress(body, *interpolate(times))

    return Mover(place, _REACH, body.stature + 0.1, parts)


_GROUND, _PELVIS, _WAIST_JOINT, _NECK, _HEAD = range(5)
_SIDES = 5
"""First joint of the left side: shoulder, elbow, hand, hip, knee, ankle; then those of the right side."""


def _move_joints(
    walk: SimulatedWalk,
    options: PeopleOptions,
    body: Body,
    ground: Callable[[Array], Array],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Joints (J, 3, K) and yaws (3, K) at each sample of a walk."""
    H, count = body.stature, len(walk.positions)
    legs = add_legs(walk, draw_gait(options, rng), ANKLE_HEIGHT)

    def wander(stddev: float, seconds: float) -> Array:
        """(K,) slow random motion."""
        return stddev * draw_drift(count, seconds, rng)

    # What people do beside walking: they shift their weight, and look around.
    yaw = walk.headings + wander(0.06, 1.5)
    ahead, left = _axes(yaw)
    floor = gaussian_filter1d(ground(walk.positions), 0.1 / SAMPLE_INTERVAL, mode="nearest")
    ankles = [leg.positions for leg in legs]
    speeds = [np.linalg.norm(np.gradient(one, SAMPLE_INTERVAL, axis=0), axis=1) for one in ankles]
    lifts = [_LIFT * np.minimum(one / _FULL_SPEED, 1) for one in speeds]
    apart = np.sum((ankles[0] - ankles[1]) * ahead.T[:, :2], axis=1)
    leg = (_HIP - _ANKLE) * H
    bob = _BOB * (leg - np.sqrt(np.maximum(leg**2 - apart**2 / 4, 0)))
    aside = 0.03 * (speeds[1] - speeds[0]) / (speeds[0] + speeds[1] + 0.5) + wander(0.015, 2.0)
    stride = np.clip(apart / 0.6, -1.2, 1.2)
    turns = np.stack([yaw - 0.09 * stride, yaw + 0.13 * stride, walk.headings + wander(0.35, 1.5)])
    pelvis = np.concatenate([walk.positions.T, [floor + _HIP * H - bob]]) + aside * left
    up = np.array([[0.0], [0.0], [1.0]])

    def over(height: float) -> Array:
        """On the axis of the torso at a height over the stature."""
        return np.asarray(pelvis + (height - _HIP) * H * (np.cos(body.lean) * up + np.sin(body.lean) * ahead))

    skull = over(_CHIN) + np.cos(body.gaze) * body.head[2] * up + (0.02 + np.sin(body.gaze) * 0.1) * ahead
    joints = [np.concatenate([walk.positions.T, [floor]]), pelvis, over(_WAIST), over(_SHOULDER), skull]
    chest_ahead, chest_left = _axes(turns[1])
    for k, side in enumerate((1.0, -1.0)):
        shoulder = over(_SHOULDER) + side * _HALF_SHOULDERS * H * chest_left
        angle = -side * body.swing[k] * stride
        elbow = shoulder + _UPPER_ARM * H * _direction(angle, chest_ahead, side * 0.12 * chest_left)
        hand = elbow + _FOREARM * H * _direction(
            angle + body.bend[k] + 0.3 * np.maximum(angle, 0), chest_ahead, -side * 0.05 * chest_left
        )
        hip = pelvis + side * _HALF_HIPS * H * _axes(turns[0])[1]
        ankle = np.concatenate([ankles[k].T, [floor + _ANKLE * H + lifts[k]]])
        joints += [shoulder, elbow, hand, hip, _bend_knee(hip, ankle, H, ahead), ankle]
    return np.stack(joints), turns


def _bend_knee(hip: Array, ankle: Array, stature: float, ahead: Array) -> Array:
    """(3, K) the knee, before the line from hip to ankle by as much as the lengths of thigh and shank require."""
    thigh, shank = (_HIP - _KNEE) * stature, (_KNEE - _ANKLE) * stature
    length = np.linalg.norm(ankle - hip, axis=0)
    axis = (ankle - hip) / length
    along = np.clip((thigh**2 - shank**2 + length**2) / (2 * length), 0, thigh)
    across = ahead - np.sum(ahead * axis, axis=0) * axis
    return np.asarray(hip + along * axis + np.sqrt(thigh**2 - along**2) * across / np.linalg.norm(across, axis=0))


def _direction(angle: Array, ahead: Array, aside: Array) -> Array:
    """(3, K) down, turned ahead by an angle, and a little aside."""
    down = np.array([[0.0], [0.0], [-1.0]])
    return np.asarray(np.cos(angle) * down + np.sin(angle) * ahead + aside)


def _axes(yaw: Array) -> tuple[Array, Array]:
    """(3, G) unit vectors ahead and to the left."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    return np.stack([c, s, zero]), np.stack([-s, c, zero])


def turn_body(yaw: Array, pitch: float = 0.0) -> Array:
    """(3, 3, G) rotations with x ahead and down by the pitch, rad."""
    ahead, left = _axes(yaw)
    up = np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), ahead.shape)
    c, s = np.cos(pitch), np.sin(pitch)
    return np.stack([c * ahead - s * up, left, s * ahead + c * up], axis=1)


def _dress(body: Body, joints: Array, yaws: Array) -> list[Part]:
    """The solids of a person."""
    H, g = body.stature, body.girth
    skin, top, bottom = body.greys
    pelvis_ahead, chest_ahead = _axes(yaws[0])[0], _axes(yaws[1])[0]
    chest = turn_body(yaws[1], body.lean)
    pelvis, waist, neck, skull = joints[_PELVIS], joints[_WAIST_JOINT], joints[_NECK], joints[_HEAD]
    down = np.array([[0.0], [0.0], [-1.0]])
    parts = [
        place_ellipsoid(turn_body(yaws[2], body.gaze), skull, body.head, skin),
        place_limb(neck, skull, 0.062, 0.055, skin),
        place_limb(pelvis, waist, (0.118 * g, 0.17 * g), 0.145 * g, bottom, pelvis_ahead),
        place_limb(waist, neck + 0.06 * H * down, (0.11 * g, 0.14 * g), 0.165 * g, top, chest_ahead),
        place_ellipsoid(chest, neck + 0.02 * down, (0.095 * g, 0.125 * H, 0.08), top),
    ]
    for side in (0, 1):
        shoulder, elbow, hand, hip, knee, ankle = joints[_SIDES + 6 * side : _SIDES + 6 * side + 6]
        toe = ankle + _FOOT * H * 0.75 * pelvis_ahead + 0.02 * down
        heel = ankle - 0.05 * pelvis_ahead + 0.02 * down
        parts += [
            place_limb(shoulder, elbow, 0.055, 0.042, top),
            place_limb(elbow, hand, 0.042, 0.034, top if body.coat else skin),
            place_limb(hip, knee, 0.085 * g**0.5, 0.06, bottom),
            place_limb(knee, ankle, 0.06, 0.042, bottom),
            place_limb(heel, toe, 0.042, 0.035, bottom),
        ]
    if body.coat:
        hem = pelvis + 0.14 * H * down
        parts.append(place_limb(neck + 0.05 * H * down, hem, (0.135 * g, 0.175 * g), 0.22 * g, top, chest_ahead))
    if body.bag == "back":
        parts.append(place_box(chest, neck - 0.19 * chest_ahead * g + 0.26 * down, (0.09, 0.15, 0.23), 0.2))
    elif body.bag == "side":
        left = _axes(yaws[0])[1]
        parts.append(
            place_box(turn_body(yaws[0]), pelvis + 0.26 * g * left + 0.05 * down, (0.17, 0.06, 0.14), 0.2)
        )
    return parts

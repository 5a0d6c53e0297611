"""The environment of the robot: a room with clutter, and the operator who carries the board."""

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.motion import BoardPlacement, pose_from_placement
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, Solid

# Sizes of an adult operator of 1.78 m, m.
_BODY_RADIUS, _BODY_HEIGHT = 0.18, 1.5
_HEAD_RADIUS, _HEAD_HEIGHT = 0.1, 0.28
_ARM_RADIUS = 0.045
_SHOULDER_HEIGHT = 1.4
_UP = np.array([0.0, 0.0, 1.0])


def build_room(rng: np.random.Generator, clutter: int, keep_clear: float) -> tuple[Solid, ...]:
    """Draws a room on the ground z = 0 around the robot at the origin, with boxes and columns in it.

    Args:
        rng: draws sizes and positions.
        clutter: number of boxes and columns.
        keep_clear: radius around the robot without walls and clutter, m.
    """
    length, width = 2 * keep_clear + rng.uniform(2.0, 6.0), 2 * keep_clear + rng.uniform(1.0, 3.0)
    height = rng.uniform(2.6, 3.4)
    shift = rng.uniform(-0.4, 0.4, 2)
    middle = np.array([*shift, height / 2])
    walls = Solid(BoxShape(length, width, height), se3.pose(_yaw_rotation(rng.uniform(-0.2, 0.2)), middle), 150.0)
    return (walls, *(_draw_clutter(rng, keep_clear) for _ in range(clutter)))


def _draw_clutter(rng: np.random.Generator, keep_clear: float) -> Solid:
    bearing = rng.uniform(-np.pi, np.pi)
    brightness = rng.uniform(50, 220)
    height = rng.uniform(0.3, 2.4)
    if rng.random() < 0.5:
        shape: BoxShape | CylinderShape = BoxShape(rng.uniform(0.2, 0.9), rng.uniform(0.2, 0.9), height)
    else:
        shape = CylinderShape(rng.uniform(0.06, 0.3), height)
    extent = shape.radius if isinstance(shape, CylinderShape) else 0.5 * float(np.hypot(shape.length, shape.width))
    distance = keep_clear + extent + rng.uniform(0.0, 1.0)
    place = np.array([distance * np.cos(bearing), distance * np.sin(bearing), height / 2])
    return Solid(shape, se3.pose(_yaw_rotation(rng.uniform(-np.pi, np.pi)), place), brightness)


def board_solid(placement: BoardPlacement, size: tuple[float, float]) -> Solid:
    """The board of the given width and height (m) at a placement."""
    return Solid(RectangleShape(*size), pose_from_placement(placement))


def operator_solids(placement: BoardPlacement, size: tuple[float, float]) -> tuple[Solid, ...]:
    """The person behind the board (body, head and two arms), with hands at its left and right edges."""
    T_world_board = pose_from_placement(placement)
    outward = np.array([np.cos(placement.bearing), np.sin(placement.bearing), 0.0])
    sideways = np.array([-outward[1], outward[0], 0.0])
    feet = T_world_board[:3, 3] * [1, 1, 0] + placement.standoff * outward + placement.side * sideways
    body = _upright_cylinder(CylinderShape(_BODY_RADIUS, _BODY_HEIGHT), feet, 0.0, 70.0)
    head = _upright_cylinder(CylinderShape(_HEAD_RADIUS, _HEAD_HEIGHT), feet, _BODY_HEIGHT, 160.0)
    # Hands grip the edges from behind, clear of the printed face.
    grip = size[0] / 2 - 0.03
    hands = se3.apply(T_world_board, np.array([[side * grip, 0.0, -2 * _ARM_RADIUS] for side in (-1, 1)]))
    neck = feet + _SHOULDER_HEIGHT * _UP
    shoulders = neck + _BODY_RADIUS * np.array([[1.0], [-1.0]]) * sideways
    arms = zip(shoulders, _uncross(hands, shoulders), strict=True)
    return (body, head, *(_rod(shoulder, hand) for shoulder, hand in arms))


def _upright_cylinder(shape: CylinderShape, feet: Array, bottom: float, brightness: float) -> Solid:
    """An upright cylinder above ``feet`` (3,) whose bottom is at the height ``bottom``, m."""
    return Solid(shape, se3.pose(np.eye(3), feet + (bottom + shape.height / 2) * _UP), brightness)


def _uncross(hands: Array, shoulders: Array) -> Array:
    """The hands in the order in which arms do not cross."""
    straight = np.linalg.norm(hands - shoulders, axis=1).sum()
    crossed = np.linalg.norm(hands[::-1] - shoulders, axis=1).sum()
    return hands if straight <= crossed else hands[::-1]


def _rod(a: Array, b: Array) -> Solid:
    """A thin cylinder from a to b, both (3,)."""
    length = float(np.linalg.norm(b - a))
    z = (b - a) / length
    x = np.cross(_UP if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return Solid(
        CylinderShape(_ARM_RADIUS, length), se3.pose(np.stack([x, np.cross(z, x), z], axis=1), (a + b) / 2), 90.0
    )


def _yaw_rotation(yaw: float) -> Array:
    return so3.exp(np.array([0.0, 0.0, yaw]))

"""Surroundings of a simulated drive, built around the robot's route: rooms, halls, yards, a corridor, a field."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.drive_motion import INTERVAL, Route
from calgraph.simulation.solids import (
    BoxShape,
    CylinderShape,
    FrustumShape,
    RectangleShape,
    ReliefShape,
    Shape,
    SphereShape,
    Surface,
)

WorldKind = Literal["room", "hall", "yard", "corridor", "field"]


@dataclass(frozen=True)
class Layout:
    """What a kind of world contains."""

    reach: tuple[float, float]
    """Half of length and width of the area of routes, m."""
    margin: tuple[float, float]
    """Least and largest distance from the route to each outer wall, m."""
    height: tuple[float, float]
    """Of the walls, m."""
    ceiling: bool
    walls: tuple[int, ...]
    """Which of the four sides have a wall."""
    reliefs: int
    """Pilasters, ledges and panels per wall."""
    clutter: int
    """Number of objects."""
    trees: int
    floor_relief: float
    """Amplitude of the floor's waves, m."""
    wall_relief: float
    """Amplitude of the walls' waves, m."""


LAYOUTS: dict[WorldKind, Layout] = {
    "room": Layout((3.5, 2.5), (1.5, 3.0), (2.6, 3.4), True, (0, 1, 2, 3), 4, 14, 0, 0.002, 0.003),
    "hall": Layout((9.0, 6.0), (2.0, 8.0), (4.5, 8.0), True, (0, 1, 2, 3), 7, 32, 0, 0.003, 0.005),
    "yard": Layout((12.0, 9.0), (5.0, 15.0), (4.0, 12.0), False, (0, 1, 2), 7, 26, 8, 0.012, 0.006),
    "corridor": Layout((20.0, 0.2), (1.3, 1.6), (2.5, 3.0), True, (1, 3), 0, 0, 0, 0.0, 0.0),
    "field": Layout((12.0, 9.0), (0.0, 0.0), (1.0, 1.0), False, (), 0, 0, 0, 0.015, 0.0),
}
_FLOOR_SIZE = 240.0
"""Edge of the floor, and length of a corridor: beyond the range of a LiDAR on all sides, m."""
_BODY_INTERVAL = 0.1
"""Between samples of a moving body's path, s."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """Surfaces that move together, upright."""

    surfaces: tuple[Surface, ...]
    """In the body's frame: x ahead, z up, origin on the ground."""
    times: Array
    """(K,) s from the start of the recording."""
    positions: Array
    """(K, 3) of the origin, linear in between, m."""
    yaws: Array
    """(K,) continuous, linear in between, rad."""

    @cached_property
    def bounds(self) -> tuple[Array, float]:
        """Centre (3,) and radius of a sphere in the body's frame that holds the body, m."""
        places = np.array([surface.T_world_shape[:3, 3] for surface in self.surfaces])
        centre = places.mean(axis=0)
        reach = [surface.shape.bounding_radius for surface in self.surfaces]
        return centre, float((np.linalg.norm(places - centre, axis=1) + reach).max())

    def poses(self, times: Array) -> Array:
        """(N, 4, 4) from its frame to the world."""
        yaw = np.interp(times, self.times, self.yaws)
        place = np.stack([np.interp(times, self.times, column) for column in self.positions.T], axis=-1)
        return se3.pose(so3.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])), place)


@dataclass(frozen=True, eq=False)
class DriveWorld:
    """Surroundings and what moves in them; the world frame has z up and the floor at z = 0."""

    floor: ReliefShape
    """In the world frame."""
    without_boards: tuple[Surface, ...]
    """All that stand still but boards, with the floor and the ramps."""
    bodies: tuple[MovingBody, ...] = ()
    boards: tuple[Surface, ...] = ()
    """On walls."""

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """All that stand still."""
        return (*self.without_boards, *self.boards)

    def ground_height(self, xy: Array) -> Array:
        """(N,) height of floor and ramps at (N, 2), m."""
        height = self.floor.height_at(xy) if len(self.floor.amplitudes) else np.zeros(len(xy))
        for surface in self.surfaces:
            if isinstance(surface.shape, FrustumShape):
                T = surface.T_world_shape
                ramp = surface.shape.height_at((xy - T[:2, 3]) @ T[:2, :2])
                height = np.where(ramp > 0, np.maximum(height, ramp), height)
        return height


def build_world(
    kind: WorldKind,
    route: Route,
    clearance: float,
    uneven: bool,
    ramps: bool,
    glass: int,
    rng: np.random.Generator,
) -> DriveWorld:
    """Builds surroundings that leave the route free.

    Args:
        kind: of the world.
        route: of the robot.
        clearance: of objects from the route, m.
        uneven: whether the floor has waves.
        ramps: whether the robot drives over a ramp and a threshold.
        glass: number of panes.
        rng: for the world.
    """
    layout = LAYOUTS[kind]
    # Buildings are not aligned with the frame in which poses are stated.
    angle = float(route.yaws[0]) if kind == "corridor" else rng.uniform(-np.pi, np.pi)
    T_world_building = upright(np.zeros(3), angle)
    path = route.positions[:: int(0.2 / INTERVAL)] @ T_world_building[:2, :2]
    margins = rng.uniform(*layout.margin, (2, 2)) + [[clearance], [clearance]] * np.array(kind != "corridor")
    bounds = np.stack([path.min(axis=0) - margins[0], path.max(axis=0) + margins[1]])
    floor = build_relief(_FLOOR_SIZE, _FLOOR_SIZE, layout.floor_relief if uneven else 0.0, rng)
    built = build_walls(layout, bounds, rng)
    built += _draw_clutter(layout, bounds, path, clearance, rng)
    if layout.walls and kind != "corridor":
        for _ in range(glass):
            pane = RectangleShape(rng.uniform(1.0, 3.0), 2.2)
            place = _draw_place(bounds, path, clearance + pane.width / 2, rng)
            built.append(Surface(pane, upright([*place, 1.1], rng.uniform(0, np.pi)) @ _STANDING, 0.3, True))
    surfaces = [Surface(s.shape, T_world_building @ s.T_world_shape, s.reflectivity, s.glass) for s in built]
    surfaces.append(Surface(floor, np.eye(4), rng.uniform(0.15, 0.5)))
    if ramps:
        surfaces += _draw_ramps(kind, route, rng)
    return DriveWorld(floor, tuple(surfaces))


def build_walls(layout: Layout, bounds: Array, rng: np.random.Generator) -> list[Surface]:
    """Walls with pilasters, ledges and panels, neither exactly upright nor square, and the ceiling with beams."""
    height = rng.uniform(*layout.height)
    centre, size = bounds.mean(axis=0), np.ptp(bounds, axis=0)
    square = 0.0 if not layout.reliefs else 1.0
    surfaces = []
    for side in layout.walls:
        across = size[side % 2]
        # Walls overlap at the corners; a corridor has no ends.
        width = 1.2 * size[1 - side % 2] + 1.0 if layout.reliefs else _FLOOR_SIZE
        facing = np.pi / 2 * side
        toward = np.array([np.cos(facing), np.sin(facing), 0.0])
        place = np.append(centre, height / 2) + toward * across / 2
        lean = square * rng.normal(0, 0.002, 3) * [1.0, 1.0, 4.0]
        # x along the wall, y up, z into the room.
        R = np.column_stack([np.cross([0.0, 0, 1], -toward), [0.0, 0, 1], -toward])
        T = se3.pose(so3.exp(lean) @ R, place)
        surfaces.append(Surface(build_relief(width, height, layout.wall_relief, rng), T, rng.uniform(0.3, 0.9)))
        for _ in range(layout.reliefs):
            depth = rng.choice([rng.uniform(0.02, 0.05), rng.uniform(0.1, 0.3)])
            tall, long = rng.uniform(0.4, 1.0) * height, rng.uniform(0.2, 0.8)
            shape, up = BoxShape(long, tall, 2 * depth), (tall - height) / 2
            if rng.random() < 0.5:
                shape = BoxShape(rng.uniform(0.8, 4.0), rng.uniform(0.1, 1.2), 2 * depth)
                up = rng.uniform(0.4, 0.9 * height) - height / 2
            offset = [rng.uniform(-0.45, 0.45) * (width - 1), up, 0.0]
            surfaces.append(Surface(shape, T @ se3.pose(np.eye(3), np.array(offset)), rng.uniform(0.2, 0.9)))
    if layout.ceiling:
        low = se3.pose(so3.exp(np.array([np.pi, 0, 0])), np.append(centre, height))
        length = 1.2 * size[0] + 1 if layout.reliefs else _FLOOR_SIZE
        surfaces.append(Surface(build_relief(length, 1.2 * size[1] + 1, layout.wall_relief, rng), low, 0.8))
        for _ in range(layout.reliefs // 2):
            place = [rng.uniform(*bounds[:, 0]), centre[1], height]
            beam = BoxShape(rng.uniform(0.15, 0.4), 1.2 * size[1], rng.uniform(0.2, 0.8))
            surfaces.append(Surface(beam, upright(place, rng.normal(0, 0.02)), 0.5))
            pipe = CylinderShape(rng.uniform(0.05, 0.25), 1.1 * size[0])
            along = np.column_stack([[0.0, 1, 0], [0.0, 0, 1], [1.0, 0, 0]])
            above = np.array([centre[0], rng.uniform(*bounds[:, 1]), height - rng.uniform(0.2, 0.6)])
            surfaces.append(Surface(pipe, se3.pose(along, above), 0.6))
    return surfaces


def _draw_clutter(
    layout: Layout, bounds: Array, path: Array, clearance: float, rng: np.random.Generator
) -> list[Surface]:
    """Boxes of all orientations, pillars, balls, tilted boards, trees and parked cars beside the route."""
    surfaces: list[Surface] = []

    def add(shape: Shape, T: Array) -> None:
        surfaces.append(Surface(shape, T, float(rng.choice([0.08, 0.3, 0.5, 0.8]))))

    big = 1.0 if layout.ceiling and layout.clutter < 20 else 1.6
    for _ in range(layout.clutter):
        kind = rng.random()
        yaw, lean = rng.uniform(-np.pi, np.pi), rng.normal(0, 1, 3)
        if kind < 0.6:
            length, width, height = big * rng.uniform([0.3, 0.2, 0.3], [1.4, 1.0, 1.6])
            place = _draw_place(bounds, path, clearance + np.hypot(length, width) / 2, rng)
            T = upright([*place, height / 2 - 0.05], yaw)
            if kind < 0.25:
                T[:3, :3] = so3.exp(np.radians(25) * lean / np.linalg.norm(lean)) @ T[:3, :3]
            add(BoxShape(length, width, height), T)
        elif kind < 0.75:
            radius, height = rng.uniform(0.08, 0.4), rng.uniform(1.0, 5.0)
            place = _draw_place(bounds, path, clearance + radius, rng)
            add(CylinderShape(radius, height), upright([*place, height / 2 - 0.05], yaw))
        elif kind < 0.85:
            radius = rng.uniform(0.2, 0.6)
            place = _draw_place(bounds, path, clearance + radius, rng)
            add(SphereShape(radius), upright([*place, rng.uniform(0.8, 3.0) * radius], 0.0))
        else:
            board = RectangleShape(*big * rng.uniform(0.8, 1.8, 2))
            place = _draw_place(bounds, path, clearance + board.bounding_radius, rng)
            T = upright([*place, rng.uniform(0.4, 1.2)], yaw)
            T[:3, :3] = T[:3, :3] @ so3.exp(np.array([np.radians(rng.uniform(25, 85)), 0, 0]))
            add(board, T)
    for _ in range(layout.trees):
        place = _draw_place(bounds, path, clearance + 0.4, rng)
        height, radius = rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.3)
        trunk = upright([*place, height / 2 - 0.1], 0.0)
        trunk[:3, :3] = so3.exp(rng.normal(0, 0.06, 3))
        add(CylinderShape(radius, height), trunk)
        for _ in range(3):
            crown = np.append(place, height + 0.5) + rng.normal(0, 0.7, 3)
            add(SphereShape(rng.uniform(0.6, 1.3)), upright(crown, 0.0))
        car = _draw_place(bounds, path, clearance + 2.4, rng)
        T = upright([*car, 0.0], rng.uniform(-np.pi, np.pi))
        surfaces += [
            Surface(part.shape, T @ part.T_world_shape, part.reflectivity)
            for part in (_car(rng) if rng.random() < 0.5 else ())
        ]
    return surfaces


def _draw_ramps(kind: WorldKind, route: Route, rng: np.random.Generator) -> list[Surface]:
    """A ramp with a flat top across the route, a threshold, and outdoors a long slope."""
    rate = int(1 / INTERVAL)
    # Where the robot drives ahead, and rather straight: it would slide off a ramp in a curve.
    usable = np.flatnonzero((route.speeds > 0.3) & (np.abs(route.turn_rates) < 0.3))
    usable = usable[(usable > 4 * rate) & (usable < len(route.times) - 4 * rate)]
    if not len(usable):
        return []
    run = rng.uniform(0.8, 1.2) if kind == "room" else rng.uniform(1.2, 2.5)
    # 4 to 8 degrees, as ramps for wheels have.
    ramp = FrustumShape(
        (rng.uniform(0.5, 1.5), 1.6), (run, 0.6 * run), run * np.tan(np.radians(rng.uniform(4, 8)))
    )
    # Driven over in a tenth of a second.
    threshold = FrustumShape((0.25, 3.0), (0.06, 0.2), rng.uniform(0.015, 0.04))
    slope = FrustumShape((rng.uniform(2, 6), 6.0), (rng.uniform(5, 9), 6.0), rng.uniform(0.25, 0.5))
    surfaces = []
    for shape in (ramp, threshold, slope)[: 3 if kind == "yard" else 2]:
        # Where it is crossed for the least time: a floor of ramps is none.
        places = rng.choice(usable, 8)
        gaps = route.positions[places, None] - route.positions[::20]
        at = int(places[np.argmin(np.sum(np.sum(gaps**2, axis=2) < shape.bounding_radius**2, axis=1))])
        yaw = float(route.yaws[at]) + rng.normal(0, 0.15)
        surfaces.append(Surface(shape, upright([*route.positions[at], 0.0], yaw), rng.uniform(0.2, 0.6)))
    return surfaces


def draw_bodies(
    route: Route, clearance: float, people: int, cars: int, truck: bool, rng: np.random.Generator
) -> tuple[MovingBody, ...]:
    """People who walk around the robot, cars that pass it, and a truck that drives beside it.

    None comes nearer to the robot than ``clearance``, m.
    """
    times = np.arange(route.times[0], route.times[-1], _BODY_INTERVAL)
    robot = np.stack([np.interp(times, route.times, column) for column in route.positions.T], axis=-1)
    bodies: list[MovingBody] = []
    for _ in range(people):
        bodies += _draw_person(times, robot, clearance, rng)
    for _ in range(cars):
        heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 5.0)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        nearest = robot.mean(axis=0) + rng.uniform(3.0, 8.0) * np.array([-ahead[1], ahead[0]])
        moved = speed * (times - rng.uniform(times[0], times[-1]))
        positions = _keep_away(nearest + moved[:, None] * ahead, robot, clearance + 3.0)
        bodies.append(_body(tuple(_car(rng)), times, positions, np.full(len(times), heading)))
    if truck:
        smooth = 2.5 / _BODY_INTERVAL
        yaws = gaussian_filter1d(np.interp(times, route.times, route.yaws), smooth)
        side: Array = rng.choice([-1.0, 1.0]) * np.stack([-np.sin(yaws), np.cos(yaws)], axis=-1)
        ahead = np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)
        along = 1.5 * np.sin(2 * np.pi * times / rng.uniform(12, 25) + rng.uniform(0, 6))
        beside = (
            gaussian_filter1d(robot, smooth, axis=0)
            + (clearance + rng.uniform(1.5, 2.2)) * side
            + along[:, None] * ahead
        )
        parts = (
            Surface(BoxShape(12.0, 2.5, 3.6), upright([0.0, 0, 2.1], 0.0), 0.7),
            Surface(BoxShape(2.0, 2.3, 2.8), upright([7.2, 0, 1.7], 0.0), 0.5),
        )
        bodies.append(_body(parts, times, _keep_away(beside, robot, clearance + 1.6), yaws))
    return tuple(bodies)


def _draw_person(times: Array, robot: Array, clearance: float, rng: np.random.Generator) -> list[MovingBody]:
    """Torso with head and two legs, which swing."""
    low, high = robot.min(axis=0) - 4, robot.max(axis=0) + 4
    position, goal = rng.uniform(low, high), rng.uniform(low, high)
    speed, positions = rng.uniform(0.6, 1.5), np.empty((len(times), 2))
    for k in range(len(times)):
        way = goal - position
        if np.linalg.norm(way) < 0.3:
            goal = rng.uniform(low, high)
        position = position + speed * _BODY_INTERVAL * way / max(float(np.linalg.norm(way)), 0.1)
        positions[k] = position
    positions = _keep_away(gaussian_filter1d(positions, 3, axis=0), robot, clearance + 0.5)
    velocity = np.asarray(np.gradient(positions, _BODY_INTERVAL, axis=0))
    yaws = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    ahead = np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    swing = 0.25 * np.sin(2 * np.pi * 0.9 * times)[:, None] * ahead
    torso = (
        Surface(CylinderShape(0.2, 0.65), upright([0.0, 0, 1.15], 0.0), 0.4),
        Surface(SphereShape(0.12), upright([0.0, 0, 1.6], 0.0), 0.5),
    )
    leg = (Surface(CylinderShape(0.08, 0.85), upright([0.0, 0, 0.425], 0.0), 0.2),)
    return [
        _body(torso, times, positions, yaws),
        _body(leg, times, positions + swing + 0.11 * left, yaws),
        _body(leg, times, positions - swing - 0.11 * left, yaws),
    ]


def _keep_away(positions: Array, robot: Array, least: float) -> Array:
    """Positions (K, 2) moved out to a least distance from the robot's (K, 2)."""
    away = positions - robot
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    return np.asarray(robot + away * np.maximum(1.0, least / distance))


def _body(surfaces: Sequence[Surface], times: Array, positions: Array, yaws: Array) -> MovingBody:
    return MovingBody(tuple(surfaces), times, np.column_stack([positions, np.zeros(len(times))]), yaws)


def _car(rng: np.random.Generator) -> list[Surface]:
    """A car's parts in its frame."""
    length, paint = rng.uniform(3.6, 4.8), float(rng.choice([0.08, 0.4, 0.8]))
    cabin = upright([-0.2, 0.0, 1.15], 0.0)
    cabin[:3, :3] = so3.exp(np.array([0.0, rng.normal(0, 0.03), 0.0]))
    wheels = [
        Surface(CylinderShape(0.32, 0.2), upright([x, y, 0.32], 0.0) @ _STANDING, 0.06)
        for x in (-0.3 * length, 0.3 * length)
        for y in (-0.75, 0.75)
    ]
    body = Surface(BoxShape(length, 1.75, 0.6), upright([0.0, 0.0, 0.6], 0.0), paint)
    return [body, Surface(BoxShape(0.5 * length, 1.5, 0.6), cabin, paint), *wheels]


def _draw_place(bounds: Array, path: Array, clearance: float, rng: np.random.Generator) -> Array:
    """(2,) a place within the bounds that is clear of the path, or outside where none was found."""
    for _ in range(60):
        place = rng.uniform(*bounds)
        if np.min(np.sum((path - place) ** 2, axis=1)) > clearance**2:
            return np.asarray(place)
    corner = np.where(rng.random(2) < 0.5, bounds[0] - clearance, bounds[1] + clearance)
    return np.asarray(corner)


def build_relief(width: float, height: float, amplitude: float, rng: np.random.Generator) -> ReliefShape:
    """A rectangle with five waves of 1 to 6 m; their sum has about the given amplitude."""
    count = 5 if amplitude else 0
    angles, lengths = rng.uniform(0, np.pi, count), rng.uniform(1.0, 6.0, count)
    vectors = 2 * np.pi / lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # Short waves are flatter: slopes of all waves are of one size.
    amplitudes = amplitude * lengths / 6.0 * rng.uniform(0.3, 1.0, count)
    return ReliefShape(width, height, amplitudes, vectors, rng.uniform(0, 2 * np.pi, count))


_STANDING = se3.pose(so3.exp(np.array([np.pi / 2, 0.0, 0.0])), np.zeros(3))
"""Turns a shape's z to -y: rectangles stand, cylinders are axles across."""


def upright(place: Sequence[float] | Array, yaw: float) -> Array:
    """(4, 4) of a shape that is turned about the vertical only."""
    return se3.pose(so3.exp(np.array([0.0, 0.0, yaw])), np.asarray(place, dtype=np.float64))

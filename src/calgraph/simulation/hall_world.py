"""Halls: walls with pilasters, doors, pillars, shelves, tables, panes and mirrors, and what moves in them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.drive_world import Layout, build_relief, build_walls, upright
from calgraph.simulation.hall_bodies import Mover
from calgraph.simulation.hall_people import add_person
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_vehicles import build_mover, draw_vehicles, drive_vehicle, measure_reach
from calgraph.simulation.network_floor import Floor, FreeSpace, find_free_space, rectangle
from calgraph.simulation.network_people import form_parties, separate_people
from calgraph.simulation.network_scenario import PeopleOptions
from calgraph.simulation.network_walks import Party, SimulatedWalk, body_clearance, draw_walks
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, ReliefShape, Surface

_LENGTHS, _WIDTHS = (12.0, 25.0), (10.0, 18.0)
"""Of halls, m."""
_HALL = Layout((0.0, 0.0), (0.0, 0.0), (4.5, 7.0), True, (0, 1, 2, 3), 7, 0, 0, 0.004, 0.005)
"""Walls with pilasters, ledges and panels; waves of floor and walls of 4 and 5 mm."""
_CORE = 0.6
"""Share of the reach of a vehicle that its path keeps free."""
_PASSAGE = 1.0
"""Least distance of furniture from furniture, m."""
_DRAWS = 60
"""Of a place for a piece of furniture, which is left out then."""
_RISE, _TREAD = 0.16, 0.3
"""Of steps, m."""
_MOVING_TIME = 1.5
"""In which a chair or a door is moved, s."""


@dataclass(frozen=True, eq=False)
class Hall:
    """A hall with its floor at z = 0 in its middle, and what moves in it."""

    size: Array
    """(3,) length, width and height, m; its middle is at x = y = 0."""
    surfaces: tuple[Surface, ...]
    mirrors: tuple[Surface, ...]
    """Rectangles that reflect from their +z side."""
    movers: tuple[Mover, ...]
    walks: tuple[SimulatedWalk, ...]
    """Of people, then of vehicles."""
    ground: Callable[[Array], Array]
    """Height (N,) of the floor at (N, 2), m."""
    furniture: Array
    """(F, 3) circles that hold the furniture: x, y, radius, m."""


def build_hall(scenario: HallScenario) -> Hall:
    """Draws a hall and what moves in it.

    Raises:
        InputError: there are too many people for it.
    """
    rng, walk_rng, people_rng, thing_rng = (np.random.default_rng((scenario.seed, k)) for k in range(4))
    size = np.array([rng.uniform(*_LENGTHS), rng.uniform(*_WIDTHS), rng.uniform(*_HALL.height)])
    size[2] = max(size[2], 6.5 * scenario.high)
    half = size[:2] / 2
    layout = replace(_HALL, height=(size[2], size[2]))
    surfaces = build_walls(layout, np.stack([-half, half]), rng)
    floor, ground = _lay_floor(scenario, size, rng)
    surfaces += floor
    surfaces += _hang_doors(half, rng)
    furniture, obstacles = _furnish(size, ground, scenario.glass, rng)
    surfaces += furniture
    mirrors = tuple(
        Surface(RectangleShape(2.0, 2.0), _on_wall(half, int(side), rng.uniform(-0.4, 0.4), 1.2, 0.35), 0.5)
        for side in rng.permutation(4)[: scenario.mirrors]
    )
    vehicles = draw_vehicles(scenario.carts, float(size[:2].min()), np.random.default_rng((scenario.seed, 4)))
    walks, drives = _draw_paths(scenario, half, obstacles, [measure_reach(one) for one in vehicles], walk_rng)
    options = _people_options(scenario)
    movers = [add_person(walk, options, ground, people_rng) for walk in walks]
    movers += [drive_vehicle(walk, ground, boxes, 0.5) for walk, boxes in zip(drives, vehicles, strict=True)]
    movers += _move_things(scenario, half, ground, thing_rng)
    circles = [[*one.mean(axis=0), np.linalg.norm(np.ptp(one, axis=0)) / 2] for one in obstacles]
    return Hall(
        size, tuple(surfaces), mirrors, tuple(movers), (*walks, *drives), ground, np.reshape(circles, (-1, 3))
    )


def _lay_floor(
    scenario: HallScenario, size: Array, rng: np.random.Generator
) -> tuple[list[Surface], Callable[[Array], Array]]:
    """The floor, which falls by half of its slope in one direction, and is a valley or ridge by the other half."""
    relief = build_relief(60.0, 60.0, _HALL.floor_relief, rng)
    angles, length = rng.uniform(-np.pi, np.pi, 2), 2.2 * float(size[0])
    share = rng.uniform(0.3, 1.0) if scenario.floor_slope <= 0.01 else 1.0
    valley = 0.5 * share * scenario.floor_slope * length / (2 * np.pi)
    fall = 0.5 * share * scenario.floor_slope * np.array([np.cos(angles[1]), np.sin(angles[1])])
    wave = 2 * np.pi / length * np.array([np.cos(angles[0]), np.sin(angles[0])])
    shape = ReliefShape(
        relief.width, relief.height, np.append(relief.amplitudes, valley),
        np.vstack([relief.wave_vectors, wave]), np.append(relief.phases, rng.uniform(0, 2 * np.pi)),
    )  # fmt: skip
    lowered = -float(shape.height_at(np.zeros((1, 2)))[0])
    R = so3.exp(np.array([fall[1], -fall[0], 0.0]))
    surfaces = [Surface(shape, se3.pose(R, np.array([0.0, 0.0, lowered])), rng.uniform(0.15, 0.5))]
    steps = int(rng.integers(2, 6)) if scenario.stairs else 0
    begin, sign = rng.uniform(0.05, 0.2) * size[0], rng.choice([-1.0, 1.0])
    for k in range(steps):
        length = size[0] / 2 + 1 - begin - k * _TREAD
        middle = sign * (begin + k * _TREAD + length / 2)
        # From far below the floor to the height of the step.
        box = BoxShape(length, float(size[1]) + 2, 2.0)
        surfaces.append(Surface(box, upright([middle, 0.0, (k + 1) * _RISE - 1.0], 0.0), 0.4))

    def ground(xy: Array) -> Array:
        height = lowered + shape.height_at(xy) + xy @ fall
        on = np.clip(np.floor((sign * xy[:, 0] - begin) / _TREAD) + 1, 0, steps)
        return np.where(on > 0, np.maximum(height, on * _RISE), height)

    return surfaces, ground


def _on_wall(half: Array, side: int, along: float, height: float, standoff: float) -> Array:
    """(4, 4) of what is fixed to a wall: x along it, y up, z into the hall; ``along`` as a share of its length."""
    facing = np.pi / 2 * side
    toward = np.array([np.cos(facing), np.sin(facing), 0.0])
    across, length = half[side % 2], 2 * half[1 - side % 2]
    x = np.cross([0.0, 0, 1], -toward)
    place = (across - standoff) * toward + along * length * x + [0.0, 0, height]
    return se3.pose(np.column_stack([x, [0.0, 0, 1], -toward]), place)


def _hang_doors(half: Array, rng: np.random.Generator) -> list[Surface]:
    """Doors with frames: leaves lie 5 to 10 cm behind the front of their frames."""
    surfaces = []
    for _ in range(3):
        T = _on_wall(half, int(rng.integers(4)), rng.uniform(-0.4, 0.4), 0.0, rng.uniform(0.0, 0.03))
        width, depth = rng.uniform(0.9, 2.0), rng.uniform(0.1, 0.2)
        for x, y, w, h in (
            (-width / 2 - 0.08, 1.05, 0.16, 2.1), (width / 2 + 0.08, 1.05, 0.16, 2.1), (0.0, 2.2, width + 0.3, 0.2)
        ):  # fmt: skip
            frame = BoxShape(w, h, 2 * depth)
            surfaces.append(Surface(frame, T @ se3.pose(np.eye(3), np.array([x, y, 0.0])), 0.6))
        leaf = BoxShape(width, 2.1, 0.08)
        surfaces.append(Surface(leaf, T @ se3.pose(np.eye(3), np.array([0.0, 1.05, 0.0])), 0.5))
    return surfaces


def _furnish(
    size: Array, ground: Callable[[Array], Array], glass: int, rng: np.random.Generator
) -> tuple[list[Surface], list[Array]]:
    """Pillars, shelves, tables, crates and panes; and what they cover of the floor, as polygons (4, 2), m."""
    surfaces: list[Surface] = []
    obstacles: list[Array] = []
    circles: list[tuple[float, float, float]] = []
    half = size[:2] / 2
    kinds = rng.choice(["pillar", "shelf", "table", "crate"], int(rng.integers(5, 11))).tolist()
    for kind in [*kinds, *glass * ["pane"]]:
        length, width = {
            "pillar": (0.4, 0.4), "shelf": (rng.uniform(1, 3), 0.5), "table": (rng.uniform(1.2, 2), 0.8),
            "crate": tuple(rng.uniform(0.5, 1.2, 2)), "pane": (rng.uniform(1.5, 3), 0.1),
        }[kind]  # fmt: skip
        radius = float(np.hypot(length, width)) / 2
        for _ in range(_DRAWS):
            place = rng.uniform(-half + radius + 0.3, half - radius - 0.3)
            # The middle of the hall stays free, as installers choose where people walk.
            free = np.hypot(*place) > 2.0 + radius
            if free and all(np.hypot(*(place - one[:2])) > radius + one[2] + _PASSAGE for one in circles):
                break
        else:
            continue
        yaw = rng.choice([0, np.pi / 2]) + rng.normal(0, 0.1)
        circles.append((*place, radius))
        obstacles.append(rectangle(place, (length, width), yaw))
        T = upright([*place, float(ground(place[None])[0])], yaw)
        if kind == "pane":
            standing = se3.pose(so3.exp(np.array([np.pi / 2, 0.0, 0.0])), np.array([0.0, 0, 1.1]))
            surfaces.append(Surface(RectangleShape(length, 2.2), T @ standing, 0.3, glass=True))
        surfaces += [
            Surface(shape, T @ se3.pose(np.eye(3), np.array(middle)), float(rng.choice([0.1, 0.3, 0.5, 0.8])))
            for shape, middle in _build_piece(kind, length, width, float(size[2]), rng)
        ]
    return surfaces, obstacles


def _build_piece(
    kind: str, length: float, width: float, ceiling: float, rng: np.random.Generator
) -> list[tuple[BoxShape | CylinderShape, tuple[float, float, float]]]:
    """Upright shapes of a piece of furniture with their middles over the floor, m."""
    if kind == "pillar":
        shape = CylinderShape(0.2, ceiling) if rng.random() < 0.5 else BoxShape(length, width, ceiling)
        return [(shape, (0, 0, ceiling / 2))]
    if kind == "shelf":
        boards = np.arange(0.1, rng.uniform(1.6, 2.4), 0.45).tolist()
        goods = [z for z in boards if rng.random() < 0.7]
        return [
            *((BoxShape(length, width, 0.03), (0, 0, z)) for z in boards),
            *((BoxShape(length * rng.uniform(0.3, 0.9), 0.4, 0.3), (0, 0, z + 0.16)) for z in goods),
            *((BoxShape(0.04, width, 2.2), (x, 0, 1.1)) for x in (-length / 2, length / 2)),
        ]
    if kind == "table":
        x, y = length / 2 - 0.08, width / 2 - 0.08
        legs = [(a, b, 0.365) for a in (-x, x) for b in (-y, y)]
        return [
            (BoxShape(length, width, 0.03), (0, 0, 0.74)),
            *((CylinderShape(0.025, 0.73), leg) for leg in legs),
        ]
    if kind == "crate":
        height = rng.uniform(0.4, 1.6)
        return [(BoxShape(length, width, height), (0, 0, height / 2))]
    return []


def _people_options(scenario: HallScenario) -> PeopleOptions:
    return PeopleOptions(
        shape="legs", count=scenario.people, couples=scenario.couples, speed=1.1, speed_spread=0.3, stop_every=12.0
    )


def _draw_paths(
    scenario: HallScenario, half: Array, obstacles: list[Array], reaches: list[float], rng: np.random.Generator
) -> tuple[tuple[SimulatedWalk, ...], tuple[SimulatedWalk, ...]]:
    """Walks of people, and of vehicles with these reaches, m."""
    # Pilasters, doors and mirrors take up to 0.4 m of the floor along the walls.
    floor = Floor(rectangle(np.zeros(2), 2 * half - 0.8), True, tuple(obstacles))
    options = _people_options(scenario)

    def find_space(reach: float) -> FreeSpace:
        return find_free_space(floor, body_clearance(options, reach), np.zeros((0, 3)))

    parties = form_parties(options, find_space)
    walks = draw_walks(parties, np.zeros((0, 2)), options, 0.0, scenario.duration + 1.0, rng)
    # One by one: large bodies that heed each other block each other for minutes. Corners may touch furniture.
    vehicles = [
        draw_walks(
            [Party(_CORE * reach, find_space(_CORE * reach))], np.zeros((0, 2)), options, 0.0,
            scenario.duration + 1.0, rng,
        )[0]
        for reach in reaches
    ]  # fmt: skip
    return separate_people(options, walks, rng), tuple(vehicles)


def _move_things(
    scenario: HallScenario, half: Array, ground: Callable[[Array], Array], rng: np.random.Generator
) -> list[Mover]:
    """Chairs that are moved by some decimetres sometimes, and leaves of doors that turn about hinges on walls."""
    chair = [((0.0, 0.0, 0.45), (0.22, 0.22, 0.025)), ((-0.21, 0.0, 0.7), (0.015, 0.2, 0.22))]
    chair += [((x, y, 0.22), (0.015, 0.015, 0.22)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    leaf = [((0.5, 0.0, 1.02), (0.45, 0.02, 1.02))]
    movers = []
    for _ in range(scenario.moved):
        changes = _draw_changes(scenario, rng)
        steps = rng.normal(0, [0.4, 0.4, 0.7], (len(changes) + 1, 3))
        stands = np.append(rng.uniform(-half + 1, half - 1), 0.0) + np.cumsum(steps, axis=0)
        movers.append(build_mover(_stand(stands, changes, ground), chair, 0.3))
        T = _on_wall(half, int(rng.integers(4)), rng.uniform(-0.4, 0.4), 0.0, 0.3)
        changes = _draw_changes(scenario, rng)
        opened = rng.uniform(0.5, 1.8) * (np.arange(len(changes) + 1) % 2)
        closed = np.array([*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])])
        movers.append(build_mover(_stand(closed + opened[:, None] * [0, 0, 1], changes, ground), leaf, 0.5))
    return movers


def _draw_changes(scenario: HallScenario, rng: np.random.Generator) -> Array:
    """(M,) ascending times, s, at least 5 s apart."""
    slots = max(int(scenario.duration / 8), 1)
    count = min(int(rng.integers(1, 4)), slots)
    return np.sort(8.0 * rng.choice(slots, count, replace=False) + rng.uniform(0.5, 3.0, count))


def _stand(
    stands: Array, changes: Array, ground: Callable[[Array], Array]
) -> Callable[[Array], tuple[Array, Array]]:
    """Poses x, y, yaw (M + 1, 3), of which each holds until one of the changes (M,), s."""
    knots = np.sort(np.concatenate([changes, changes + _MOVING_TIME]))
    held = np.repeat(stands.T, 2, axis=1)[:, 1:-1]

    def pose(times: Array) -> tuple[Array, Array]:
        x, y, yaw = (np.interp(times, knots, row) for row in held)
        return np.stack([x, y, ground(np.stack([x, y], axis=1))]), yaw

    return pose

"""The buildings of simulated networks: floors with furniture, scanners and stations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation.floor_index import BoxIndex
from calgraph.simulation.network_building import lay_out_building
from calgraph.simulation.network_floor import (
    Floor,
    distance_to_segments,
    points_inside,
    polygon_sides,
    rectangle,
)
from calgraph.simulation.network_plan import Layout, wall
from calgraph.simulation.network_scenario import NetworkScenario

_WALL_OFFSET = 0.5
"""Distance of a scanner from the wall that it is mounted on, m."""
_CUBOID_EDGE = 10.0
"""Edge of the cuboid in the middle of the ring, m (section VI)."""
_MIN_WALL_DISTANCE = 0.15
"""Minimum distance of a scanner from any wall, m."""
_MIN_VIEW_DISTANCE = 0.8
"""Minimum distance of a scanner from furniture, m."""
_MIN_PASSAGE = 0.9
"""Minimum width between furniture, and from it to walls, m: wide enough for one person."""
_THIN_FRACTION = 0.3
"""Fraction of the furniture that is thin."""


def build_layout(scenario: NetworkScenario, rng: np.random.Generator) -> Layout:
    """Builds the layout of a scenario, with scanners mounted and furniture placed at random.

    Raises:
        InputError: the scanners' jitter puts them into walls.
    """
    plan = _LAYOUT_BUILDERS[scenario.layout](scenario)
    plan = replace(plan, mounts=_jitter_mounts(plan, scenario, rng))
    furniture = _place_furniture(plan, scenario.clutter, rng)
    return replace(plan, floor=replace(plan.floor, obstacles=(*plan.floor.obstacles, *furniture)))


def _ring(scenario: NetworkScenario) -> Layout:
    radius = scenario.ring_diameter / 2
    outline = (radius - 1) * _unit_vectors(2 * np.pi * np.arange(48) / 48)
    # Radii alternate, so that tracks are not one circle; halfway between two scanners both detect the person.
    turns = np.arange(4 * scenario.scanner.count) / (4 * scenario.scanner.count)
    wobble = np.tile([0.0, 1.0, 0.0, -1.0], scenario.scanner.count) * 0.1 * radius
    middle = (radius - 1 + _CUBOID_EDGE / np.sqrt(2)) / 2 + 0.1 * radius
    stations = (middle + wobble)[:, None] * _unit_vectors(2 * np.pi * turns)
    return Layout(
        Floor(outline, False, (rectangle((0, 0), (_CUBOID_EDGE, _CUBOID_EDGE)),)),
        _mounts_on_arc(radius, np.arange(scenario.scanner.count) * 2 * np.pi / scenario.scanner.count),
        stations,
        furniture_areas=np.zeros((0, 4)),
        keep_clear=np.zeros((0, 3)),
    )


def _office(scenario: NetworkScenario) -> Layout:
    outline = rectangle((8.0, 5.5), (16.0, 11.0))
    return _fully_furnished(Floor(outline, True, ()), _mounts_along_walls(outline, scenario.scanner.count))


def _semicircle(scenario: NetworkScenario) -> Layout:
    outline = rectangle((0.0, 3.5), (16.0, 11.0))
    mounts = _mounts_on_arc(6.5, np.linspace(0, np.pi, scenario.scanner.count))
    return _fully_furnished(Floor(outline, True, ()), mounts)


def _lab(scenario: NetworkScenario) -> Layout:
    outline = np.array([(0, 0), (8, 0), (8, 3.5), (4, 3.5), (4, 7), (0, 7)], dtype=np.float64)
    return _fully_furnished(Floor(outline, True, ()), _mounts_along_walls(outline, scenario.scanner.count))


def _halls(scenario: NetworkScenario) -> Layout:
    """Two halls side by side with a gate between them and a door each to the corridor along both.

    Each scanner's field of view overlaps with two others only, and the four form a cycle.
    """
    outline = rectangle((13.0, 13.0), (26.0, 26.0))
    walls = (
        wall((0, 3.4), (1.5, 3.4)), wall((4.5, 3.4), (21.5, 3.4)), wall((24.5, 3.4), (26, 3.4)),
        wall((15, 3.4), (15, 19)), wall((15, 23), (15, 26)),
    )  # fmt: skip
    mounts = np.array([(5.0, 20.0, -0.9), (21.5, 20.0, -2.2), (0.6, 1.6, 0.4), (25.4, 1.6, 2.7)])
    stations = np.array(
        [
            (3, 2),
            (7, 8),
            (9.5, 12.5),
            (11.5, 19.5),
            (15, 21),
            (18.5, 20),
            (16.8, 12.5),
            (19, 8),
            (23, 2),
            (13, 1.8),
        ]
    )
    # Doors, and the line of sight from each hall's scanner through the gate.
    doors = [(3, 3.4, 3.5), (23, 3.4, 3.5), (15, 21, 3.5), (8.5, 20.5, 2.8), (18.5, 20.3, 2.5)]
    return Layout(
        Floor(outline, True, walls),
        mounts[: scenario.scanner.count],
        stations,
        np.array([(0, 3.6, 15, 26), (15, 3.6, 26, 26)]),
        np.concatenate([doors, np.column_stack([stations, np.full(len(stations), 1.5)])]),
    )


def _grid(scenario: NetworkScenario) -> Layout:
    """A floor of equal bays with a scanner in each, walls with openings between some, columns at the corners."""
    count, pitch = scenario.scanner.count, scenario.grid_spacing
    columns = int(np.ceil(np.sqrt(1.2 * count)))
    rows = int(np.ceil(count / columns))
    size = np.array([columns, rows]) * pitch
    bays = np.array([(column, row) for row in range(rows) for column in range(columns)])[:count]
    centers = (bays + 0.5) * pitch
    # Off the middle of its bay and facing across it, as on a column.
    yaws = np.arctan2(*(size / 2 - centers + 1e-9).T[::-1])
    mounts = np.column_stack([centers - 0.25 * pitch * _unit_vectors(yaws), yaws])
    corners = [(x * pitch, y * pitch) for x in range(1, columns) for y in range(1, rows)]
    posts = [rectangle(corner, (0.5, 0.5)) for corner in corners]
    # Every second bay has a wall to its right neighbour over half of the side.
    walls = [
        wall((x * pitch, y * pitch), (x * pitch, (y + 0.5) * pitch))
        for x in range(1, columns)
        for y in range(rows)
        if (x + y) % 2
    ]
    return _fully_furnished(Floor(rectangle(size / 2, size), True, (*posts, *walls)), mounts)


def _building(scenario: NetworkScenario) -> Layout:
    return lay_out_building(scenario.scanner.count)


_LAYOUT_BUILDERS = {
    "ring": _ring, "office": _office, "semicircle": _semicircle, "lab": _lab, "halls": _halls, "grid": _grid,
    "building": _building,
}  # fmt: skip


def _fully_furnished(floor: Floor, mounts: Array) -> Layout:
    """A layout with furniture anywhere and no stations."""
    everywhere = np.concatenate([floor.outline.min(axis=0), floor.outline.max(axis=0)])[None]
    return Layout(floor, mounts, np.zeros((0, 2)), everywhere, np.zeros((0, 3)))


def _unit_vectors(angles: Array) -> Array:
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _mounts_on_arc(radius: float, angles: Array) -> Array:
    """Mounts (N, 3) on an arc around the origin, facing it."""
    return np.column_stack([radius * _unit_vectors(angles), angles + np.pi])


def _mounts_along_walls(outline: Array, count: int) -> Array:
    """Mounts (N, 3) evenly spaced along a counter-clockwise polygon, facing its interior."""
    edges = polygon_sides(outline)
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    at = (np.arange(count) + 0.5) / count * starts[-1]
    side = np.searchsorted(starts, at, side="right") - 1
    along = (edges[side, 1] - edges[side, 0]) / lengths[side, None]
    inwards = np.stack([-along[:, 1], along[:, 0]], axis=1)
    # Away from corners, where two walls would be too near.
    into = np.clip(at - starts[side], 1.5 * _WALL_OFFSET, lengths[side] - 1.5 * _WALL_OFFSET)
    places = edges[side, 0] + into[:, None] * along + _WALL_OFFSET * inwards
    return np.column_stack([places, np.arctan2(inwards[:, 1], inwards[:, 0])])


def _jitter_mounts(plan: Layout, scenario: NetworkScenario, rng: np.random.Generator) -> Array:
    """Mounts (N, 3) with random offsets from their nominal poses, but not in a wall."""
    most = np.array([scenario.scanner.position_jitter] * 2 + [np.radians(scenario.scanner.yaw_jitter)])
    mounts = []
    for nominal in plan.mounts:
        tries = nominal + rng.uniform(-1, 1, (100, 3)) * most
        fits = (
            plan.floor.clearance(tries[:, :2]) >= _MIN_WALL_DISTANCE if plan.floor.walled else np.full(100, True)
        )
        if not fits.any():
            raise InputError(
                f"scanner.position_jitter: {scenario.scanner.position_jitter:g} m puts the scanner at "
                f"({nominal[0]:.1f}, {nominal[1]:.1f}) into a wall; take less"
            )
        mounts.append(tries[np.argmax(fits)])
    return np.array(mounts)


def _place_furniture(plan: Layout, count: int, rng: np.random.Generator) -> list[Array]:
    """Places rectangles at random, clear of scanners and doors: desks, cupboards, thin objects such as plants.

    Fewer than ``count`` where the floor is full.
    """
    scanners = np.column_stack([plan.mounts[:, :2], np.full(len(plan.mounts), _MIN_VIEW_DISTANCE)])
    clear = np.concatenate([scanners, plan.keep_clear])
    pieces, placed = list[Array](), BoxIndex()
    for _ in range(20 * count if len(plan.furniture_areas) else 0):
        if len(pieces) == count:
            break
        low_x, low_y, high_x, high_y = plan.furniture_areas[rng.integers(len(plan.furniture_areas))]
        center = rng.uniform((low_x, low_y), (high_x, high_y))
        size = rng.uniform(0.08, 0.25, 2) if rng.random() < _THIN_FRACTION else rng.uniform(0.4, 1.4, 2)
        reach = 0.5 * float(np.hypot(*size))
        room = reach + _MIN_PASSAGE
        near = [pieces[k] for k in placed.near(center - room, center + room)]
        gap = min(plan.floor.clearance(center[None])[0], _distance_to_polygons(center, near))
        away = np.linalg.norm(clear[:, :2] - center, axis=1) - clear[:, 2]
        if gap > room and away.min() > reach:
            piece = rectangle(center, size, rng.uniform(0, np.pi))
            placed.add(piece.min(axis=0), piece.max(axis=0))
            pieces.append(piece)
    return pieces


def _distance_to_polygons(point: Array, polygons: Sequence[Array]) -> float:
    """Distance of a point (2,) from the nearest polygon, m; 0 inside."""
    if any(points_inside(polygon, point[None])[0] for polygon in polygons):
        return 0.0
    sides = [polygon_sides(polygon) for polygon in polygons]
    return float(distance_to_segments(point[None], np.concatenate(sides))[0]) if sides else np.inf

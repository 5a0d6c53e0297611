"""The buildings of simulated networks: floors with furniture, scanners and stations."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation.network_floor import (
    Boxes,
    Floor,
    distance_to_segments,
    points_inside,
    polygon_sides,
    rectangle,
)
from calgraph.simulation.network_scenario import NetworkScenario
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, SimulatedWalk


@dataclass(frozen=True, eq=False)
class Layout:
    """A building with its scanners."""

    floor: Floor
    mounts: Array
    """(N, 3) x, y, m, and yaw, rad, of the scanners."""
    stations: Array
    """(K, 2) goals that people walk to one after the other, m; without any, goals are random."""
    furniture_areas: Array
    """(A, 4) rectangles for furniture: x and y of the lower left, then of the upper right corner, m."""
    keep_clear: Array
    """(C, 3) circles without furniture, such as doorways: x, y, radius, m."""
    trip: float = np.inf
    """Distance within which people have random goals, along each axis, m."""


def wall(a: Sequence[float], b: Sequence[float], thickness: float = 0.15) -> Array:
    """(4, 2) a straight wall from a to b."""
    along = np.subtract(b, a)
    return rectangle(np.add(a, b) / 2, (float(np.hypot(*along)), thickness), float(np.arctan2(along[1], along[0])))


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
    pieces, placed = list[Array](), Boxes(*np.full((2, count, 2), np.nan))
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
            placed.low[len(pieces)], placed.high[len(pieces)] = piece.min(axis=0), piece.max(axis=0)
            pieces.append(piece)
    return pieces


def _distance_to_polygons(point: Array, polygons: Sequence[Array]) -> float:
    """Distance of a point (2,) from the nearest polygon, m; 0 inside."""
    if any(points_inside(polygon, point[None])[0] for polygon in polygons):
        return 0.0
    sides = [polygon_sides(polygon) for polygon in polygons]
    return float(distance_to_segments(point[None], np.concatenate(sides))[0]) if sides else np.inf


_BLOCK_LENGTH, _BLOCK_DEPTH, _CORRIDOR_WIDTH = 18.0, 12.0, 3.0
"""m."""
_PITCH = _BLOCK_DEPTH + _CORRIDOR_WIDTH
"""From one corridor to the next, m."""
_OFFICE_LENGTH = 6.0
"""m."""
_OFFICE_DOORS, _OFFICE_DOOR_WIDTH = (3.0, 9.0, 15.0), 1.8
"""Middles along a block, and width, m."""
_HALL_DOORS, _HALL_DOOR_WIDTH = (4.5, 13.5), 2.4
_CORRIDOR_MOUNTS = (1.2, 6.9, 11.1)
"""Of scanners along a block, m: beside all doors, and near enough for a range of 10 m."""
_POST_SIZE = (0.5, 0.5)
"""Of the columns in halls, m."""
_DOOR_CLEARANCE = 1.0
"""Free of furniture around a door, beyond half of its width, m."""
_VIEW_CLEARANCE = 0.5
"""Free of furniture on either side of the line from an office's scanner to the door, m."""
_TRIP = 25.0
"""People walk to rooms within this distance along each axis, m: at their speed they reach several in a minute."""
_CORRIDOR, _HALL, _SECOND_IN_HALL, _OFFICE = range(4)
"""Ranks of mounts: scanners are left out of offices first, then of halls that keep two."""
_GOLDEN_RATIO = 0.5 * (np.sqrt(5) - 1)


@dataclass
class _Plan:
    """What has been drawn so far."""

    walls: list[Array] = field(default_factory=list)
    mounts: list[tuple[float, float, float]] = field(default_factory=list)
    """x, y, m, and yaw, rad."""
    ranks: list[int] = field(default_factory=list)
    """Of the mounts."""
    areas: list[tuple[float, float, float, float]] = field(default_factory=list)
    """For furniture, as in the layout."""
    clear: list[tuple[float, float, float]] = field(default_factory=list)
    """Free of furniture: x, y, radius, m."""

    def mount(self, rank: int, x: float, y: float, yaw: float) -> None:
        """Adds the place of a scanner."""
        self.mounts.append((x, y, yaw))
        self.ranks.append(rank)

    def wall_with_doors(self, x: float, y: float, doors: tuple[float, ...], width: float) -> None:
        """Adds the wall of a block to a corridor, from x on, with doors in it."""
        edges = [0.0, *(door + side * width / 2 for door in doors for side in (-1, 1)), _BLOCK_LENGTH]
        self.walls += [wall((x + a, y), (x + b, y)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        self.clear += [(x + door, y, width / 2 + _DOOR_CLEARANCE) for door in doors]


def lay_out_building(count: int) -> Layout:
    """The layout for a number of scanners, the least building about as wide as long that has places for them."""
    sizes = [(columns, _count_rows(columns, count)) for columns in range(1, 2 + int(np.sqrt(count)))]
    columns, rows = min(sizes, key=lambda size: max(_width(size[0]), size[1] * _PITCH))
    plan = _Plan()
    for row in range(rows + 1):
        for column in range(columns):
            _add_corridor(plan, row, column)
            if row < rows:
                _add_block(plan, row, column, columns)
    extent = np.array([_width(columns), rows * _PITCH + _CORRIDOR_WIDTH])
    return Layout(
        Floor(rectangle(extent / 2, extent), True, tuple(plan.walls)),
        np.array(plan.mounts)[_choose_mounts(plan.ranks, count)],
        np.zeros((0, 2)),
        np.array(plan.areas),
        np.array(plan.clear),
        _TRIP,
    )


def _count_rows(columns: int, count: int) -> int:
    """Rows of blocks that have places for all scanners."""
    rows, places = 0, columns * len(_CORRIDOR_MOUNTS)
    while places < count or rows == 0:
        halls = sum(_is_hall(rows, column) for column in range(columns))
        places += columns * len(_CORRIDOR_MOUNTS) + (columns - 1) // 2 + 4 * halls + 6 * (columns - halls)
        rows += 1
    return rows


def _is_hall(row: int, column: int) -> bool:
    return (row + column) % 2 == 0


def _left(column: int) -> float:
    """Left end of a block, m."""
    return column * _BLOCK_LENGTH + column // 2 * _CORRIDOR_WIDTH


def _width(columns: int) -> float:
    """Of the whole building, m."""
    return _left(columns - 1) + _BLOCK_LENGTH


def _choose_mounts(ranks: list[int], count: int) -> list[int]:
    """The mounts that have a scanner, in order; those of one rank are left out evenly."""
    # Multiples of the golden ratio modulo 1 are spread evenly, however many are taken.
    order = sorted(range(len(ranks)), key=lambda k: (ranks[k], k * _GOLDEN_RATIO % 1))
    return sorted(order[:count])


def _add_corridor(plan: _Plan, row: int, column: int) -> None:
    """The scanners of the corridor below a row of blocks, on both walls in turn."""
    for k, along in enumerate(_CORRIDOR_MOUNTS):
        upper = (k + column + row) % 2 == 1
        y = row * _PITCH + (_CORRIDOR_WIDTH - _WALL_OFFSET if upper else _WALL_OFFSET)
        plan.mount(_CORRIDOR, _left(column) + along, y, -np.pi / 2 if upper else np.pi / 2)


def _add_block(plan: _Plan, row: int, column: int, columns: int) -> None:
    """A hall or offices, and the crossing corridor on the right."""
    left, low = _left(column), row * _PITCH + _CORRIDOR_WIDTH
    right, high = left + _BLOCK_LENGTH, low + _BLOCK_DEPTH
    doors = (_HALL_DOORS, _HALL_DOOR_WIDTH) if _is_hall(row, column) else (_OFFICE_DOORS, _OFFICE_DOOR_WIDTH)
    for y in (low, high):
        plan.wall_with_doors(left, y, *doors)
    if _is_hall(row, column):
        _furnish_hall(plan, left, low)
    else:
        _divide_into_offices(plan, left, low)
    if column < columns - 1:
        plan.walls.append(wall((right, low), (right, high)))
    if column < columns - 1 and column % 2 == 1:
        plan.walls.append(wall((right + _CORRIDOR_WIDTH, low), (right + _CORRIDOR_WIDTH, high)))
        plan.mount(_CORRIDOR, right + _WALL_OFFSET, (low + high) / 2, 0.0)


def _furnish_hall(plan: _Plan, left: float, low: float) -> None:
    middle, high = low + _BLOCK_DEPTH / 2, low + _BLOCK_DEPTH
    plan.walls += [rectangle((left + along, middle), _POST_SIZE) for along in (6.0, 12.0)]
    plan.mount(_SECOND_IN_HALL, left + 1.5, low + _WALL_OFFSET, np.radians(60))
    plan.mount(_SECOND_IN_HALL, left + 16.5, high - _WALL_OFFSET, np.radians(-120))
    plan.mount(_HALL, left + 10.0, low + _WALL_OFFSET, np.radians(90))
    plan.mount(_HALL, left + 8.0, high - _WALL_OFFSET, np.radians(-90))
    # As often as offices for each area.
    edges = np.arange(left, left + _BLOCK_LENGTH + 1, _OFFICE_LENGTH)
    plan.areas += [(a, y, b, y + _BLOCK_DEPTH / 2) for a, b in pairwise(edges) for y in (low, middle)]


def _divide_into_offices(plan: _Plan, left: float, low: float) -> None:
    middle, high = low + _BLOCK_DEPTH / 2, low + _BLOCK_DEPTH
    plan.walls.append(wall((left, middle), (left + _BLOCK_LENGTH, middle)))
    for along in (_OFFICE_LENGTH, 2 * _OFFICE_LENGTH):
        plan.walls.append(wall((left + along, low), (left + along, high)))
    for k, door in enumerate(_OFFICE_DOORS):
        a = left + k * _OFFICE_LENGTH
        for bottom, side, exit_y in ((low, -1, low), (middle, 1, high)):
            plan.areas.append((a, bottom, a + _OFFICE_LENGTH, bottom + _BLOCK_DEPTH / 2))
            # On the wall opposite to the door, which it faces.
            place = np.array([a + 2.0, middle + side * _WALL_OFFSET])
            towards = np.array([left + door, exit_y]) - place
            x, y = place.tolist()
            plan.mount(_OFFICE, x, y, float(np.arctan2(towards[1], towards[0])))
            between = place + np.outer([0.25, 0.5, 0.75], towards)
            plan.clear += [(x, y, _VIEW_CLEARANCE) for x, y in between.tolist()]


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

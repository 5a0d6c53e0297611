"""A floor plan for any number of scanners: corridors, halls that are open to two of them, and offices.

Corridors run along x, 15 m apart, and between every two of them is a row of blocks of 18 m by 12 m. Halls and
blocks of six offices take turns like the fields of a chessboard. After every second block a corridor crosses.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_floor import Floor, rectangle
from calgraph.simulation.network_plan import Layout, wall

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
_WALL_OFFSET = 0.5
"""Distance of a scanner from its wall, m."""
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

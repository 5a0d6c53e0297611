"""Boards on walls that a driving robot passes, and its cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Board, Tag
from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.simulation.drive_motion import Route
from calgraph.simulation.drive_scenario import CameraErrors, DriveScenario
from calgraph.simulation.solids import RectangleShape, Surface, cast_rays, surface_normals

_SIZE, _TAG, _TAG_CENTRE = 0.7, 0.26, 0.18
"""Edge of a board, edge of its four tags, and distance of their centres from the board's axes, m."""
_STANDOFF = 0.02
"""Of boards from walls, m."""
_HEIGHTS, _DISTANCES = (0.5, 1.8), (1.0, 5.0)
"""Of the middles of boards over the floor, and from the route, m."""
_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class WallBoard:
    """A board on a wall, as it is printed."""

    board: Board
    """As rig.yaml states it."""
    T_world_board: Array
    """(4, 4)."""
    stretch: Array
    """(2,) of the print along x and y."""
    bow: Array
    """(2,) of the middle over the edges, along x and y, m."""

    def bend(self, corners: Array) -> Array:
        """Corners (..., 3) of the exact print as they are printed, in the board's frame."""
        x, y = corners[..., 0], corners[..., 1]
        z = self.bow[0] * (1 - (2 * x / _SIZE) ** 2) + self.bow[1] * (1 - (2 * y / _SIZE) ** 2)
        return np.stack([self.stretch[0] * x, self.stretch[1] * y, z], axis=-1)


@dataclass(frozen=True, eq=False)
class DriveCamera:
    """A camera of the robot."""

    stated: CameraModel
    """As its CameraInfo states it."""
    true: CameraModel


@dataclass(frozen=True, eq=False)
class SimulatedBoards:
    """Boards and cameras of a drive."""

    boards: tuple[WallBoard, ...] = ()
    cameras: Mapping[str, DriveCamera] = field(default_factory=dict)


def hang_boards(
    scenario: DriveScenario, route: Route, surfaces: Sequence[Surface], rng: np.random.Generator
) -> tuple[WallBoard, ...]:
    """Boards on upright surfaces around the route.

    Raises:
        InputError: the surroundings have too few walls.
    """
    errors = scenario.camera_errors
    found: list[WallBoard] = []
    scale, aspect = errors.print_scale * rng.normal(), errors.print_aspect * rng.normal()
    stretch = (1 + scale) * np.array([1 + aspect / 2, 1 - aspect / 2])
    for _ in range(_DRAWS):
        if len(found) == scenario.boards:
            return tuple(found)
        place = np.append(route.positions[rng.integers(len(route.times))], rng.uniform(*_HEIGHTS))
        bearing = rng.uniform(-np.pi, np.pi)
        hit = _find_wall(surfaces, place, np.array([np.cos(bearing), np.sin(bearing), 0.0]))
        if hit is None:
            continue
        point, normal = hit
        near = any(np.linalg.norm(point - one.T_world_board[:3, 3]) < 1.2 * _SIZE for one in found)
        if near or not _DISTANCES[0] < np.min(np.linalg.norm(route.positions - point[:2], axis=1)) < _DISTANCES[1]:
            continue
        across = np.cross([0.0, 0, 1], normal)
        across /= np.linalg.norm(across)
        R = np.column_stack([across, np.cross(normal, across), normal]) @ so3.exp(
            np.radians([0, 0, 3 * rng.normal()])
        )
        T = se3.pose(R, point + _STANDOFF * normal)
        found.append(WallBoard(make_wall_board(len(found)), T, stretch, errors.bow * rng.normal(size=2)))
    raise InputError(f"the surroundings have no walls for {scenario.boards} boards; choose a room or a hall")


def _find_wall(surfaces: Sequence[Surface], place: Array, direction: Array) -> tuple[Array, Array] | None:
    """Where a ray first meets a flat upright surface that holds a board, and the normal there."""
    hit = cast_rays(surfaces, place[None], direction[None])
    wall = surfaces[hit.solid[0]]
    if hit.solid[0] < 0 or wall.glass or wall.shape.bounding_radius < 2 * _SIZE:
        return None
    point = place + hit.ranges[0] * direction
    T = wall.T_world_shape
    normal = T[:3, :3] @ surface_normals(wall.shape, se3.apply(se3.inverse(T), point[None]))[0]
    normal = -normal if normal @ direction > 0 else normal
    return (point, normal) if abs(normal[2]) < 0.05 and -normal @ direction > 0.5 else None


def make_wall_board(number: int) -> Board:
    """A board with four tags that no other has."""
    places = ((-1, 1), (1, 1), (1, -1), (-1, -1))
    tags = tuple(
        Tag(id=4 * number + k, size=_TAG, center=(x * _TAG_CENTRE, y * _TAG_CENTRE))
        for k, (x, y) in enumerate(places)
    )
    return Board(size=(_SIZE, _SIZE), tags=tags)


def board_surface(board: WallBoard) -> Surface:
    """What LiDARs hit of a board."""
    return Surface(RectangleShape(_SIZE, _SIZE), board.T_world_board, 0.6)


def draw_camera(
    field_of_view: float, size: tuple[int, int], errors: CameraErrors, rng: np.random.Generator
) -> DriveCamera:
    """A lens with barrel distortion, and what a CameraInfo states of it.

    Args:
        field_of_view: horizontal, degrees.
        size: of the images, pixels.
        errors: of the statement.
        rng: for these.
    """
    width, height = size
    f = width / 2 / np.tan(np.radians(field_of_view / 2)) * (1 - 0.08)
    centre = np.array([width / 2, height / 2]) + rng.normal(0, 8, 2)
    stated = CameraModel(
        "pinhole", width, height, np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]]),
        np.array([-0.12, 0.03, *rng.normal(0, 3e-4, 2), 0.0]),
    )  # fmt: skip
    radius = float(np.hypot(width, height)) / 2 / f
    k1 = errors.distortion / (f * radius**3) * rng.normal()
    change = np.array([
        *np.repeat(f * errors.focal * rng.normal(), 2), *errors.centre * rng.normal(size=2),
        k1, 0.3 * k1 * rng.normal(), *1e-4 * errors.distortion * rng.normal(size=2), 0.0,
    ])  # fmt: skip
    return DriveCamera(stated, stated.with_intrinsics(stated.intrinsics + change))

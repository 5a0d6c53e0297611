"""Boards on walls that a driving robot passes, its cameras, and the corners that these would detect."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Board, Tag
from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.simulation.drive_motion import Motion, Route
from calgraph.simulation.drive_robot import DriveMount
from calgraph.simulation.drive_scenario import CameraErrors, DriveScenario
from calgraph.simulation.drive_surfaces import Surface, surface_normals
from calgraph.simulation.solids import RectangleShape

_SIZE, _TAG, _TAG_CENTRE = 0.7, 0.26, 0.18
"""Edge of a board, edge of its four tags, and distance of their centres from the board's axes, m."""
_STANDOFF = 0.02
"""Of boards from walls, m."""
_HEIGHTS, _DISTANCES = (0.5, 1.8), (1.0, 5.0)
"""Of the middles of boards over the floor, and from the route, m."""
_DRAWS = 2000
_MIN_TAG_PIXELS, _MIN_COSINE, _MAX_BLUR = 22.0, 0.35, 5.0
"""Tags that are smaller, more slanted, or blurred by more pixels are not detected."""
_OUTLIERS = 0.01
"""Probability that a blurred or badly lit view has corners that are wrong together."""
_OUTLIER_SIZE = 1.5
"""Standard deviation of their displacement, pixels."""


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
class SimulatedView:
    """The corners of a board in one image."""

    stamp: float
    """By the camera's clock, s."""
    board: int
    ids: NDArray[np.intp]
    """(M,) of the tags."""
    pixels: Array
    """(M, 4, 2)."""


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
    best, wall = np.inf, None
    for surface in surfaces:
        R, t = surface.T_world_shape[:3, :3], surface.T_world_shape[:3, 3]
        distance = float(surface.shape.distance((R.T @ (place - t))[:, None], (R.T @ direction)[:, None])[0])
        if distance < best:
            best, wall = distance, surface
    if wall is None or wall.glass or wall.shape.bounding_radius < 2 * _SIZE:
        return None
    point = place + best * direction
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


def detect_corners(
    scenario: DriveScenario,
    mount: DriveMount,
    motion: Motion,
    found: SimulatedBoards,
    surfaces: Sequence[Surface],
    rng: np.random.Generator,
) -> list[SimulatedView]:
    """The corners that a camera would detect: with noise, blur, rows that are read one after another.

    Args:
        scenario: with the errors of cameras.
        mount: of the camera.
        motion: of the robot.
        found: boards and cameras.
        surfaces: that may hide boards.
        rng: for the noise.
    """
    camera, errors = found.cameras[mount.sensor.name].true, scenario.camera_errors
    clock = mount.clock
    times = np.arange(clock.phase, scenario.duration, clock.period)
    stamps = scenario.start_time + clock.stamps(times) + rng.normal(0, errors.stamp_jitter, len(times))
    views = []
    for number, board in enumerate(found.boards):
        nominal = _tag_corners(board.board)
        points = board.T_world_board[:3, :3] @ board.bend(nominal).reshape(-1, 3).T
        points = points.T + board.T_world_board[:3, 3]
        pixels = _project_at(motion, mount, camera, times, points)
        # Each row is measured at its own time; the stamp is of the middle one.
        late = np.nan_to_num((pixels[..., 1] / camera.height - 0.5) * errors.readout)
        late = np.clip(late, -errors.readout, errors.readout)
        pixels = pixels + late[..., None] * _flow(motion, mount, camera, times, points)
        blur = np.linalg.norm(_flow(motion, mount, camera, times, points), axis=-1) * errors.exposure
        seen = _select_tags(pixels, blur, camera, motion, mount, times, board, surfaces)
        for k in np.flatnonzero(seen.any(axis=1)):
            tags = np.flatnonzero(seen[k])
            noise = errors.corner * (1 + 0.7 * blur[k].reshape(-1, 4)[tags, :, None])
            measured = pixels[k].reshape(-1, 4, 2)[tags] + noise * rng.normal(size=(len(tags), 4, 2))
            # Blur and light displace the corners of a view together.
            measured = measured + 0.04 * (1 + blur[k].mean()) * rng.normal(size=2)
            if rng.random() < _OUTLIERS:
                measured = measured + _OUTLIER_SIZE * rng.normal(size=2)
            views.append(
                SimulatedView(
                    float(stamps[k]), number, np.array([tag.id for tag in board.board.tags])[tags], measured
                )
            )
    return sorted(views, key=lambda view: view.stamp)


def _tag_corners(board: Board) -> Array:
    """(M, 4, 3) clockwise from the top left."""
    unit = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
    return np.array([[*tag.center, 0.0] + tag.size * unit for tag in board.tags])


def _project_at(motion: Motion, mount: DriveMount, camera: CameraModel, times: Array, points: Array) -> Array:
    """(N, P, 2) pixels of points (P, 3) at times; NaN behind the camera."""
    T = se3.inverse(mount.poses(motion, times))
    local = np.einsum("nij,pj->npi", T[:, :3, :3], points) + T[:, None, :3, 3]
    return camera.project(local.reshape(-1, 3)).reshape(len(times), -1, 2)


def _flow(motion: Motion, mount: DriveMount, camera: CameraModel, times: Array, points: Array) -> Array:
    """(N, P, 2) velocities of the images of points, pixels per second."""
    step = 1e-3
    after, before = (_project_at(motion, mount, camera, times + s, points) for s in (step, -step))
    return (after - before) / (2 * step)


def _select_tags(
    pixels: Array,
    blur: Array,
    camera: CameraModel,
    motion: Motion,
    mount: DriveMount,
    times: Array,
    board: WallBoard,
    surfaces: Sequence[Surface],
) -> NDArray[np.bool_]:
    """(N, M) which tags are detected in each image."""
    N = len(times)
    inside = camera.contains(pixels.reshape(-1, 2)).reshape(N, -1, 4).all(axis=2)
    edges = np.linalg.norm(np.diff(pixels.reshape(N, -1, 4, 2), axis=2), axis=-1)
    T = mount.poses(motion, times)
    toward = T[:, :3, 3] - board.T_world_board[:3, 3]
    distance = np.linalg.norm(toward, axis=1)
    cosine = toward @ board.T_world_board[:3, 2] / distance
    seen = inside & (edges.min(axis=2) > _MIN_TAG_PIXELS) & (blur.reshape(N, -1, 4).max(axis=2) < _MAX_BLUR)
    seen &= (cosine > _MIN_COSINE)[:, None]
    candidates = np.flatnonzero(seen.any(axis=1))
    if len(candidates):
        origins = T[candidates, :3, 3].T
        directions = -(toward[candidates] / distance[candidates, None]).T
        hidden = np.zeros(len(candidates), dtype=bool)
        for surface in surfaces:
            R, t = surface.T_world_shape[:3, :3], surface.T_world_shape[:3, 3:]
            hidden |= surface.shape.distance(R.T @ (origins - t), R.T @ directions) < distance[candidates] - 0.1
        seen[candidates[hidden]] = False
    return np.asarray(seen)

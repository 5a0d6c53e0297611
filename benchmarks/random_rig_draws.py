"""Random rigs for random_rigs.py: sensors, boards, room, captures, noise and errors, all drawn from one seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import (
    AprilGrid,
    Board,
    CameraSpec,
    Capture,
    Charuco,
    Checkerboard,
    Intrinsics,
    Lidar2dSpec,
    Lidar3dSpec,
    PixelNoise,
    RangeNoise,
    Rig,
    SensorSpec,
    Tag,
    Tolerance,
)
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.sensors.beam_pattern import BeamPattern, laser_pattern, multibeam_pattern, spinning_pattern
from calgraph.simulation import BeamOptions, RigScenario, World
from calgraph.simulation.motion import BoardPlacement, BoardTrajectory, pose_from_placement
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor, SensorClock
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, Solid
from calgraph.simulation.world import build_room, operator_solids
from ideal_detections import as_scanner
from model_error_draws import draw_errors
from model_error_kinds import KINDS
from rig_errors import ModelErrors

LAYOUTS = ("cluster", "ring", "spread", "back to back")
_R_BODY_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_SIZES = ((320, 240), (640, 480), (752, 480), (1280, 720), (1920, 1200))
_MAX_BEAMS = 8_000
"""Of one sweep, so that a recording takes seconds."""


def draw_robot(rng: np.random.Generator, small: bool, ordinary: bool) -> tuple[str, tuple[RobotSensor, ...]]:
    """The layout and its sensors: ``small`` ones have small, frequent messages, ``ordinary`` ones share a view."""
    layout = str(rng.choice(LAYOUTS, p=[0.55, 0.12, 0.25, 0.08]))
    layout = "cluster" if ordinary else layout
    count = int(rng.choice([2, 3, 4, 5, 6], p=[0.55, 0.3, 0.1, 0.03, 0.02]))
    noise = float(np.exp(rng.uniform(np.log(0.002), np.log(0.012 if ordinary else 0.04))))
    spacing = np.radians(rng.uniform(40, 100))
    robot: list[RobotSensor] = []
    for i in range(count):
        kind = str(rng.choice(["camera", "lidar2d", "lidar3d"], p=[0.45, 0.2, 0.35]))
        T = _draw_pose(rng, layout, i, count, spacing)
        name = f"{kind}_{i}"
        if kind == "camera":
            T = T @ se3.pose(_R_BODY_OPTICAL, np.zeros(3))
            robot.append(MountedCamera(name, "camera", T, SensorClock(0.0, 0.2, 0.0), draw_camera(rng, small)))
            continue
        pattern, period = _draw_laser(rng) if kind == "lidar2d" else _draw_lidar(rng, small)
        clock = SensorClock(0.0, period, float(pattern.times[-1]))
        of_beams = _draw_beam_noise(rng, noise)
        robot.append(
            MountedScanner(name, "lidar2d" if kind == "lidar2d" else "lidar3d", T, clock, pattern, of_beams)
        )
    return layout, tuple(robot)


def draw_camera(rng: np.random.Generator, small: bool) -> CameraModel:
    """Pinhole of 40 to 110 degrees, or fisheye of 110 to 180."""
    width, height = _SIZES[0 if small else rng.choice(len(_SIZES), p=[0.62, 0.3, 0.06, 0.015, 0.005])]
    shift = rng.normal(0, 0.01, 2) * width
    cx, cy = (width - 1) / 2 + shift[0], (height - 1) / 2 + shift[1]
    if rng.random() < 0.2:
        half = np.radians(rng.uniform(110, 180)) / 2
        f = width / 2 / half
        distortion = rng.normal(0, 1, 4) * [0.01, 0.003, 0.001, 0.0003]
        K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
        return CameraModel("fisheye", width, height, K, distortion)
    f = width / 2 / np.tan(np.radians(rng.uniform(40, 110)) / 2)
    K = np.array([[f, 0, cx], [0, f * (1 + rng.normal(0, 0.0005)), cy], [0, 0, 1]])
    # Up to 15 % at the corner of the image, where polynomials are then still monotonic.
    corner = np.hypot(width, height) / 2 / f
    k1 = rng.uniform(-0.15, 0.05) / corner**2
    five = np.array([k1, -0.2 * k1 / corner**2, *rng.normal(0, 0.0005, 2), 0.0])
    return CameraModel("pinhole", width, height, K, five if rng.random() < 0.8 else np.zeros(0))


def _draw_pose(rng: np.random.Generator, layout: str, index: int, count: int, spacing: float) -> Array:
    """``T_world_sensor`` (4, 4) of a sensor that faces along its x axis."""
    tilt = np.radians(rng.normal(0, 8, 2))
    roll = np.radians(180.0 if rng.random() < 0.12 else 90.0 if rng.random() < 0.05 else 0.0)
    position = np.array([rng.normal(0, 0.2), rng.normal(0, 0.3), rng.uniform(0.6, 1.5)])
    yaw = rng.normal(0, np.radians(15))
    if layout == "ring":
        yaw += spacing * (index - (count - 1) / 2)
        position[:2] += 0.3 * np.array([np.cos(yaw), np.sin(yaw)])
    elif layout == "spread":
        position[1] = rng.uniform(-2.5, 2.5)
        yaw += np.arctan2(-position[1], 3.0 - position[0])
    elif layout == "back to back" and index == 0:
        yaw += np.radians(rng.uniform(120, 240))
    turn = so3.exp(np.array([0.0, 0.0, yaw])) @ so3.exp(np.array([0.0, tilt[0], 0.0]))
    return se3.pose(turn @ so3.exp(np.array([roll + tilt[1], 0.0, 0.0])), position)


def _draw_laser(rng: np.random.Generator) -> tuple[BeamPattern, float]:
    field = rng.choice([rng.uniform(90, 180), 180.0, 270.0, 359.0])
    resolution = rng.choice([0.25, 1 / 3, 0.5, 1.0])
    return laser_pattern(np.radians(field), np.radians(resolution), 0.025), 0.1


def _draw_lidar(rng: np.random.Generator, small: bool) -> tuple[BeamPattern, float]:
    """A multi-beam LiDAR, or a 2-D scanner that spins."""
    if not small and rng.random() < 0.2:
        laser = laser_pattern(np.radians(270.0), np.radians(rng.choice([0.5, 1.0])), 0.02)
        tilt, offset = np.radians(rng.uniform(0, 10)), rng.uniform(0, 0.08)
        return spinning_pattern(laser, 0.02, tilt, offset, 1 / 3, float(np.pi)), 1.2
    rings = int(rng.choice([4, 8, 16, 32, 64], p=[0.08, 0.15, 0.45, 0.22, 0.1]))
    spread, middle = rng.uniform(15, 50) if rings > 4 else rng.uniform(3, 10), rng.uniform(-8, 4)
    elevations = np.radians(np.linspace(middle - spread / 2, middle + spread / 2, rings))
    finest = np.degrees(2 * np.pi) * rings / (_MAX_BEAMS / (3 if small else 1))
    return multibeam_pattern(elevations, np.radians(max(rng.uniform(0.15, 0.5), finest)), 0.1), 0.1


def _draw_beam_noise(rng: np.random.Generator, level: float) -> BeamOptions:
    return BeamOptions(
        range_noise=level * float(np.exp(rng.normal(0, 0.3))),
        angle_noise=float(rng.choice([0.0, rng.uniform(0, 0.002)])),
        mixed_pixels=float(rng.uniform(0, 0.5)),
        dropout=float(rng.choice([0.0, 0.005, rng.uniform(0, 0.2)])),
        min_range=0.1,
        max_range=float(rng.uniform(8, 60)),
    )


PRINTS = ("one tag", "four tags", "checkerboard", "charuco", "aprilgrid")


def draw_boards(rng: np.random.Generator, cameras: bool) -> tuple[tuple[Board, ...], str]:
    """One to three boards, and a label. Without cameras a board may be blank."""
    if not cameras and rng.random() < 0.5:
        return (Board(size=_draw_size(rng)),), "blank"
    kind = PRINTS[rng.choice(len(PRINTS), p=[0.2, 0.3, 0.2, 0.15, 0.15])]
    count = int(rng.choice([1, 2, 3], p=[0.85, 0.1, 0.05]))
    boards = tuple(_draw_board(rng, kind, _draw_size(rng), i) for i in range(count))
    while len({_shape(board, i) for i, board in enumerate(boards)}) < count:
        boards = tuple(_draw_board(rng, kind, _draw_size(rng), i) for i in range(count))
    return boards, kind if count == 1 else "several"


def smallest_feature(board: Board) -> float:
    """Edge of the smallest tag, marker or square of a board, m; 0 without a print."""
    match board.pattern:
        case None:
            return min((tag.size for tag in board.tags), default=0.0)
        case Checkerboard():
            return 2.5 * board.pattern.square
        case Charuco():
            return board.pattern.marker
        case AprilGrid():
            return board.pattern.tag_size


def _shape(board: Board, index: int) -> frozenset[int]:
    """What distinguishes a board from others: a checkerboard has only its numbers of corners."""
    pattern = board.pattern
    return frozenset((pattern.columns, pattern.rows) if isinstance(pattern, Checkerboard) else (-1 - index,))


def _draw_size(rng: np.random.Generator) -> tuple[float, float]:
    width = float(np.exp(rng.uniform(np.log(0.4), np.log(1.5))))
    ratio = 1.0 if rng.random() < 0.15 else float(rng.uniform(0.6, 1.4))
    return round(width, 3), round(float(np.clip(width * ratio, 0.4, 1.5)), 3)


def _draw_board(rng: np.random.Generator, kind: str, size: tuple[float, float], index: int) -> Board:
    """A board whose print, tags from 40 ``index`` on, differs from that of others."""
    width, height = size
    short = min(size)
    first = 40 * index
    match kind:
        case "one tag":
            edge = round(float(rng.uniform(0.5, 0.8)) * short, 3)
            return Board(size=size, tags=(Tag(id=first, size=edge),))
        case "four tags":
            edge = round(float(rng.uniform(0.22, 0.38)) * short, 3)
            x, y = 0.25 * width, 0.25 * height
            centers = ((-x, y), (x, y), (-x, -y), (x, -y))
            return Board(
                size=size, tags=tuple(Tag(id=first + i, size=edge, center=at) for i, at in enumerate(centers))
            )
        case "checkerboard":
            columns, rows = int(rng.integers(4, 9)) + index, int(rng.integers(4, 8))
            columns = columns + 1 if columns == rows and rng.random() < 0.5 else columns
            square = round(0.98 * min(width / (columns + 1), height / (rows + 1)), 4)
            return Board(
                size=size, pattern=Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=square)
            )
        case "charuco":
            columns, rows = int(rng.integers(4, 8)), int(rng.integers(4, 7))
            square = round(0.98 * min(width / columns, height / rows), 4)
            return Board(
                size=size,
                pattern=Charuco(
                    kind="charuco",
                    columns=columns,
                    rows=rows,
                    square=square,
                    marker=round(0.75 * square, 4),
                    dictionary="DICT_5X5_250",
                    first_id=first,
                ),
            )
        case _:
            columns, rows = int(rng.integers(2, 6)), int(rng.integers(2, 5))
            spacing = 0.3
            edge = min(width / (columns * (1 + spacing) + spacing), height / (rows * (1 + spacing) + spacing))
            return Board(
                size=size,
                pattern=AprilGrid(
                    kind="aprilgrid",
                    columns=columns,
                    rows=rows,
                    tag_size=round(0.98 * edge, 4),
                    tag_spacing=spacing,
                    first_id=first,
                ),
            )


GEOMETRIES = ("varied", "parallel", "upright", "one place")
_CANDIDATES = 10
"""Places that are drawn for a board, of which the one in most views is taken."""
_FEW_SHARE = 0.2
"""Share of recordings that may have fewer than eight captures."""
_MAX_VIEWS = 42, 120
"""Captures times sensors, of most recordings and of all: a recording is to take seconds."""
_RESOLVED = 22.0
"""Edge of a tag or marker that is detected in most images, pixels."""
_LOWEST, _HIGHEST = 0.5, 2.3
"""Of boards, m above the ground."""


@dataclass(frozen=True, eq=False)
class Shown:
    """One capture: everything that is in the room besides its environment."""

    boards: Mapping[int, Array]
    """``T_world_board`` (4, 4) by number of the board."""
    people: tuple[Solid, ...]
    slipped: Mapping[str, Array] = field(default_factory=dict)
    """By sensor that measured after the boards slipped, (6,) their displacement along the world's axes."""

    def boards_of(self, sensor: str) -> dict[int, Array]:
        """``T_world_board`` by number of the board while a sensor measures."""
        slip = self.slipped.get(sensor)
        return {i: T if slip is None else se3.retract(T, slip) for i, T in self.boards.items()}


def draw_captures(
    rng: np.random.Generator, robot: Sequence[RobotSensor], boards: Sequence[Board], most: int, ordinary: bool
) -> tuple[str, tuple[Shown, ...]]:
    """The kind of poses, and the captures."""
    geometry = str(rng.choice(GEOMETRIES, p=[0.68, 0.1, 0.12, 0.1]))
    geometry = "varied" if ordinary else geometry
    views = _MAX_VIEWS[0 if rng.random() < 0.95 else 1]
    most = min(most, views // len(robot))
    least = 12 if ordinary else 3 if rng.random() < _FEW_SHARE else 8
    count = int(np.clip(np.exp(rng.uniform(np.log(least), np.log(max(most, least) + 1))), 3, most))
    near, far = _draw_distances(rng, robot, boards, ordinary)
    carried = rng.random() < 0.8
    bystanders = int(rng.choice([0, 1, 2], p=[0.7, 0.2, 0.1]))
    slip_share = float(rng.choice([0.0, rng.uniform(0.03, 0.25)], p=[0.8, 0.2])) * (not ordinary)
    common = so3.exp(rng.normal(0, 0.2, 3))
    extent = 0.45 * max(max(board.size) for board in boards)
    first = _draw_place(rng, robot, near, far, extent)
    captures = []
    for k in range(count):
        # Several boards are shown in turn, or simultaneously.
        shown = range(len(boards)) if rng.random() < 0.4 else [k % len(boards)]
        placed: dict[int, Array] = {}
        for i in shown:
            place = (
                first + rng.normal(0, 0.03, 3)
                if geometry == "one place"
                else _draw_place(rng, robot, near, far, extent)
            )
            T = se3.pose(_draw_orientation(rng, geometry, place, robot, common), place)
            if all(np.linalg.norm(T[:3, 3] - other[:3, 3]) > max(boards[i].size) for other in placed.values()):
                placed[i] = T
        slipped = {}
        if rng.random() < slip_share:
            step = np.concatenate([rng.normal(0, 0.03, 3), rng.normal(0, np.radians(3), 3)])
            slipped = {sensor.name: step for sensor in robot if rng.random() < 0.5}
        people = [
            _person(rng.uniform(-np.pi, np.pi), rng.uniform(near + 1.0, far + 2.0)) for _ in range(bystanders)
        ]
        if carried:
            people += [s for i, T in placed.items() for s in operator_solids(_placement(rng, T), boards[i].size)]
        captures.append(Shown(placed, tuple(people), slipped))
    return geometry, tuple(captures)


def _draw_distances(
    rng: np.random.Generator, robot: Sequence[RobotSensor], boards: Sequence[Board], ordinary: bool
) -> tuple[float, float]:
    """Nearest and farthest distance of boards, m: mostly such that cameras resolve the print."""
    near = float(np.exp(rng.uniform(np.log(0.6), np.log(2.5))))
    far = near * float(rng.uniform(1.2, 3.0))
    focal = [float(sensor.camera.focal[0]) for sensor in robot if isinstance(sensor, MountedCamera)]
    feature = min(smallest_feature(board) for board in boards)
    if focal and feature and (ordinary or rng.random() < 0.85):
        resolved = float(np.median(focal)) * feature / _RESOLVED
        far = float(
            np.clip(resolved * np.exp(rng.uniform(np.log(0.4), np.log(0.8 if ordinary else 1.3))), 0.7, 6.0)
        )
        near = max(far / float(rng.uniform(1.2, 3.0)), 0.45)
    return near, far


def draw_environment(
    rng: np.random.Generator, captures: Sequence[Shown], boards: Sequence[Board]
) -> tuple[tuple[Solid, ...], str]:
    """A room with clutter and planes like the board, or open ground; and what it is."""
    reach = max(float(np.linalg.norm(T[:2, 3])) for shown in captures for T in shown.boards.values())
    if rng.random() < 0.15:
        ground = Solid(BoxShape(400.0, 400.0, 100.0), se3.pose(np.eye(3), np.array([0.0, 0.0, 50.0])), 150.0)
        return (ground,), "open"
    solids = list(build_room(rng, int(rng.integers(0, 12)), reach + float(rng.uniform(0.7, 2.0))))
    similar = int(rng.choice([0, 1, 3], p=[0.6, 0.25, 0.15]))
    for _ in range(similar):
        bearing, distance = rng.uniform(-1.5, 1.5), reach + rng.uniform(0.5, 1.5)
        at = np.array([distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(0.8, 1.6)])
        R = _facing(at, np.array([0.0, 0.0, 1.0])) @ so3.exp(rng.normal(0, 0.2, 3))
        width, height = np.array(boards[0].size) * rng.uniform(0.85, 1.15, 2)
        solids.append(Solid(RectangleShape(float(width), float(height)), se3.pose(R, at), 180.0))
    return tuple(solids), "similar planes" if similar else "room"


def in_view(sensor: RobotSensor, points: Array) -> Array:
    """(N,) whether points (N, 3) in the world lie in the field of view of a sensor, to some degrees."""
    at = se3.apply(se3.inverse(sensor.T_world_sensor), points)
    if isinstance(sensor, MountedCamera):
        with np.errstate(invalid="ignore"):
            return np.asarray(sensor.camera.contains(sensor.camera.project(at)))
    directions = at / np.linalg.norm(at, axis=-1, keepdims=True)
    beams = as_scanner(sensor).pattern.directions
    sparse = beams[:: max(1, len(beams) // 3000)]
    return np.asarray((directions @ sparse.T).max(axis=1) > np.cos(np.radians(8.0)))


def _draw_place(
    rng: np.random.Generator, robot: Sequence[RobotSensor], near: float, far: float, extent: float
) -> Array:
    """A position (3,) around which as much as possible, of some that are drawn, is in the view of sensors."""
    places = np.array([
        _place_before(rng, robot[int(rng.integers(len(robot)))], near, far) for _ in range(_CANDIDATES)
    ])  # fmt: skip
    around = extent * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = (places[:, None] + around).reshape(-1, 3)
    views = np.sum([in_view(sensor, points).reshape(_CANDIDATES, -1).mean(axis=1) for sensor in robot], axis=0)
    return np.asarray(places[np.argmax(views)] if rng.random() < 0.85 else places[0])


def _place_before(rng: np.random.Generator, sensor: RobotSensor, near: float, far: float) -> Array:
    """A position (3,) in the view of one sensor."""
    if isinstance(sensor, MountedCamera):
        size = np.array([sensor.camera.width, sensor.camera.height])
        direction = sensor.camera.rays((rng.uniform(0.12, 0.88, 2) * (size - 1))[None])[0]
        if not np.isfinite(direction).all():
            direction = np.array([0.0, 0.0, 1.0])
    else:
        pattern = as_scanner(sensor).pattern
        ahead = np.flatnonzero((pattern.directions[:, 0] > 0.3) & (np.abs(pattern.directions[:, 2]) < 0.4))
        direction = pattern.directions[rng.choice(ahead)] + rng.normal(0, 0.05, 3)
    place = se3.apply(sensor.T_world_sensor, (rng.uniform(near, far) * direction)[None])[0]
    place[2] = np.clip(place[2], _LOWEST, _HIGHEST)
    # The board stays in front of the robot by half a metre.
    distance = max(float(np.linalg.norm(place[:2])), 1e-6)
    place[:2] *= max(1.0, 0.6 / distance)
    return np.asarray(place)


def _draw_orientation(
    rng: np.random.Generator, geometry: str, place: Array, robot: Sequence[RobotSensor], common: Array
) -> Array:
    """(3, 3) rotation of a board at a place."""
    viewers = [s.T_world_sensor[:3, 3] for s in robot if in_view(s, place[None])[0]]
    facing = _facing(place, np.mean(viewers or [np.array([0.0, 0.0, 1.0])], axis=0))
    if geometry == "parallel":
        R_facing = _facing(np.array([3.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
        return np.asarray(R_facing @ common @ so3.exp(np.radians(rng.normal(0, 0.5, 3))))
    if geometry == "one place":
        return np.asarray(facing @ common @ so3.exp(np.radians(rng.normal(0, 2.0, 3))))
    if geometry == "upright":
        return np.asarray(facing @ so3.exp(np.array([0.0, np.radians(rng.uniform(-40, 40)), 0.0])))
    bearing, tilt = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(5, 50))
    axis = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.3 else np.radians(rng.normal(0, 10))
    return np.asarray(facing @ so3.exp(tilt * axis) @ so3.exp(np.array([0.0, 0.0, roll])))


def _facing(place: Array, eye: Array) -> Array:
    """(3, 3) of an upright board at a place, whose face (z) points at the eye."""
    z = (eye - place) / max(float(np.linalg.norm(eye - place)), 1e-9)
    x = np.cross([0.0, 0.0, 1.0], z)
    x = x / max(float(np.linalg.norm(x)), 1e-9)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _placement(rng: np.random.Generator, T_world_board: Array) -> BoardPlacement:
    """The board as the simulator of operators takes it."""
    x, y, z = T_world_board[:3, 3]
    plain = BoardPlacement(
        float(np.arctan2(y, x)),
        float(np.hypot(x, y)),
        float(z),
        np.eye(3),
        standoff=float(rng.uniform(0.45, 0.75)),
        side=float(rng.uniform(-0.3, 0.3)),
    )
    R_facing_board = pose_from_placement(plain)[:3, :3].T @ T_world_board[:3, :3]
    return BoardPlacement(plain.bearing, plain.radius, plain.height, R_facing_board, plain.standoff, plain.side)


def _person(bearing: float, distance: float) -> Solid:
    at = np.array([distance * np.cos(bearing), distance * np.sin(bearing), 0.85])
    return Solid(CylinderShape(0.2, 1.7), se3.pose(np.eye(3), at), 80.0)


# Kinds of model_error_kinds.py that these messages do not have, or that are drawn by themselves here.
_OTHER_KINDS = frozenset({"noise", "footprint", "tremor", "slip", "late_clock", "dark_tags"})
_OF_FIVE_COEFFICIENTS = frozenset({"distortion_dropped", "rational_lens", "fisheye_lens"})
_OF_TAGS = frozenset({"tag_position", "tag_size"})
_TOLERANCES = ((0.005, 0.2), (0.01, 0.3), (0.01, 0.3), (0.01, 0.3), (0.02, 0.5), (0.05, 1.5))
"""m and degrees; the default as often as all others."""
_ORDINARY_SHARE = 0.25
"""Share of rigs as a careful user has them: a common view, varied captures, right noise, no outlier and error."""
_TOPIC_SHARE = 0.5
"""Share of cameras whose intrinsics come from a topic."""
_MAX_PLAIN_CLOUDS = 20
"""Scans and clouds of one recording without a background."""


@dataclass(frozen=True, eq=False)
class RandomRig:
    """A rig with everything that is measured with it."""

    seed: int
    stated: Rig
    """What its user wrote."""
    robot: tuple[RobotSensor, ...]
    """True poses at the start, and stated cameras and beams."""
    boards: tuple[Board, ...]
    """As stated."""
    environment: tuple[Solid, ...]
    captures: tuple[Shown, ...]
    errors: ModelErrors
    delays: Mapping[str, float]
    """By sensor, what its clock adds to the time at which it measures, s."""
    empty: int
    """Measurements of the empty room by every sensor at the start."""
    blur: float
    """Standard deviation of the lens' point spread, pixels."""
    gray_noise: float
    """Standard deviation of a pixel, grey values."""
    mode: str
    """``snapshots``, ``trigger``, ``rest`` or ``synchronized``."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """What it is, for tables: layout, captures, board, noise, error, ..."""


def draw_rig(seed: int, moving: bool = False, unknown_lenses: float = 0.0) -> RandomRig:
    """The rig of a seed.

    Args:
        seed: of everything that is drawn.
        moving: whether the board moves all the time, in synchronized frames; otherwise the mode is drawn.
        unknown_lenses: share of cameras whose intrinsics are not stated.
    """
    rng = np.random.default_rng((seed, 18))
    mode = str(rng.choice(["snapshots", "trigger", "rest"], p=[0.78, 0.16, 0.06]))
    ordinary = bool(rng.random() < _ORDINARY_SHARE)
    mode = "synchronized" if moving else mode
    streams = mode in ("rest", "synchronized")
    layout, robot = draw_robot(rng, small=streams, ordinary=ordinary)
    boards, board_label = draw_boards(rng, cameras=any(sensor.kind == "camera" for sensor in robot))
    geometry, captures = draw_captures(rng, robot, boards, 10 if streams else 60, ordinary)
    environment, room = draw_environment(rng, captures, boards)
    root = robot[rng.integers(len(robot))].name
    noise, factors = _draw_stated_noise(rng, robot, ordinary)
    error, errors = _draw_model_errors(rng, robot, boards, root, ordinary)
    delays = {sensor.name: float(rng.uniform(-0.02, 0.02)) for sensor in robot}
    if mode == "snapshots" and rng.random() < 0.3:
        delays = {sensor.name: float(rng.uniform(-0.3, 0.3)) for sensor in robot}
    # Without a background the search of a cloud takes five times longer, and finds more candidates.
    clouds = len(captures) * sum(sensor.kind != "camera" for sensor in robot)
    empty = 0 if mode == "snapshots" and clouds <= _MAX_PLAIN_CLOUDS and rng.random() < 0.4 else 4
    translation, rotation = _TOLERANCES[rng.integers(len(_TOLERANCES))]
    stated = Rig(
        root=root,
        target=boards if len(boards) > 1 else boards[0],
        capture=_capture(mode, empty),
        sensors={sensor.name: _spec(sensor, factors[sensor.name], rng) for sensor in robot},
        tolerance=Tolerance(translation=translation, rotation=rotation),
    )
    if unknown_lenses:
        stated = _without_intrinsics(stated, unknown_lenses, rng)
    slips = np.mean([bool(shown.slipped) for shown in captures])
    labels = {
        "setup": "ordinary" if ordinary else "any",
        "mode": mode,
        "layout": layout,
        "sensors": str(len(robot)),
        "kinds": "+".join(sorted({sensor.kind for sensor in robot})),
        "board": board_label,
        "geometry": geometry,
        "captures": "3-7" if len(captures) < 8 else "8-19" if len(captures) < 20 else "20-60",
        "room": room,
        "noise": noise,
        "outliers": "none" if not slips else "some",
        "error": error,
        "tolerance": f"{1000 * translation:g} mm",
    }
    return RandomRig(
        seed,
        stated,
        robot,
        boards,
        environment,
        captures,
        errors,
        delays,
        empty,
        float(rng.uniform(0.3, 1.2)),
        float(np.exp(rng.uniform(np.log(0.5), np.log(8)))),
        mode,
        labels,
    )


def _without_intrinsics(rig: Rig, share: float, rng: np.random.Generator) -> Rig:
    sensors = {
        name: spec.model_copy(update={"intrinsics": None, "camera_info": None})
        if isinstance(spec, CameraSpec) and rng.random() < share
        else spec
        for name, spec in rig.sensors.items()
    }
    return rig.model_copy(update={"sensors": sensors})


EMPTY_STEP, POSE_STEP = 3.0, 4.0
"""Times between snapshots of the empty room, and of poses, s."""
STREAM_EMPTY = 3.0
"""Duration of the empty room in recordings of streams, s."""
TRIGGER = "/trigger"


def _capture(mode: str, empty: int) -> Capture:
    background = None
    if empty:
        background = (0.0, EMPTY_STEP * empty - 1.5 if mode == "snapshots" else STREAM_EMPTY)
    return Capture(background=background, trigger=TRIGGER if mode == "trigger" else None)


def _draw_stated_noise(
    rng: np.random.Generator, robot: Sequence[RobotSensor], ordinary: bool
) -> tuple[str, Mapping[str, float]]:
    """The class of the statement, and by sensor the stated over the true noise."""
    kind = str(rng.choice(["right", "too small", "too large", "mixed"], p=[0.6, 0.13, 0.13, 0.14]))
    kind = "right" if ordinary else kind
    bounds = {"right": (0.8, 1.25), "too small": (0.33, 0.5), "too large": (2.0, 3.0), "mixed": (0.33, 3.0)}[kind]
    low, high = np.log(bounds)
    return kind, {sensor.name: float(np.exp(rng.uniform(low, high))) for sensor in robot}


def _spec(sensor: RobotSensor, factor: float, rng: np.random.Generator) -> SensorSpec:
    topic = f"/{sensor.name}/data"
    if isinstance(sensor, MountedCamera):
        noise = PixelNoise(pixel=0.3 * factor)
        if rng.random() < _TOPIC_SHARE:
            return CameraSpec(topic=topic, camera_info=f"/{sensor.name}/camera_info", noise=noise)
        return CameraSpec(topic=topic, intrinsics=Intrinsics.from_camera(sensor.camera), noise=noise)
    true = as_scanner(sensor).noise
    stated = RangeNoise(range=max(factor * true.range_noise, 1e-4), angle=max(factor * true.angle_noise, 1e-5))
    if sensor.kind == "lidar2d":
        return Lidar2dSpec(topic=topic, noise=stated)
    return Lidar3dSpec(topic=topic, noise=stated)


def _draw_model_errors(
    rng: np.random.Generator, robot: tuple[RobotSensor, ...], boards: Sequence[Board], root: str, ordinary: bool
) -> tuple[str, ModelErrors]:
    """A label, and the errors: none, all from their priors, or one large one."""
    world = _as_world(robot, boards, root)
    which = rng.choice(["none", "priors", "one"], p=[0.35, 0.3, 0.35])
    if which == "none" or ordinary:
        return "none", ModelErrors()
    if which == "priors":
        return "priors", draw_errors(world, rng)
    cameras = [sensor.camera for sensor in robot if isinstance(sensor, MountedCamera)]
    five = all(camera.model == "pinhole" and len(camera.distortion) == 5 for camera in cameras)
    tags = len(boards) == 1 and len(boards[0].tags) > 1
    kinds = [
        kind
        for kind in KINDS
        if kind not in _OTHER_KINDS
        and (five or kind not in _OF_FIVE_COEFFICIENTS)
        and (tags or kind not in _OF_TAGS)
    ]
    while True:
        kind = kinds[rng.integers(len(kinds))]
        sizes = KINDS[kind].sizes
        size = sizes[rng.integers(len(sizes))]
        if not cameras and kind in {"focal_length", "focal_length_x", "principal_point", "image_shift"}:
            continue
        if cameras or kind not in _OF_FIVE_COEFFICIENTS:
            wrong = KINDS[kind].make(size, world, rng)
            if wrong is not None:
                return f"{kind} {KINDS[kind].label(size)}", wrong.errors


def _as_world(robot: tuple[RobotSensor, ...], boards: Sequence[Board], root: str) -> World:
    """The robot and its board as the world of model_error_kinds.py; nothing is measured in it."""
    scenario = RigScenario(board=boards[0])
    return World(scenario, 0, root, robot, BoardTrajectory(np.zeros(0), (), (), 0.0), {}, lambda _: ())


def true_poses(rig: RandomRig) -> dict[str, Array]:
    """``T_root_sensor`` (4, 4) by sensor; after a bump the pose at the end."""
    poses = {s.name: rig.errors.of_sensor(s).pose(s.T_world_sensor, 1.0) for s in rig.robot}
    T_root_world = np.linalg.inv(poses[rig.stated.root])
    return {name: T_root_world @ T for name, T in poses.items()}

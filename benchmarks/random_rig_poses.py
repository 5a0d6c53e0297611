"""Random captures and rooms for random_rigs.py: where boards, people and other planes are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Board
from calgraph.geometry import Array, se3, so3
from calgraph.simulation.ideal_detections import as_scanner
from calgraph.simulation.motion import BoardPlacement, pose_from_placement
from calgraph.simulation.robot import MountedCamera, RobotSensor
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, Solid
from calgraph.simulation.world import build_room, operator_solids
from random_rig_boards import smallest_feature

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

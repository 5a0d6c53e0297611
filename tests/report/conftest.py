"""A typical rig of five sensors, with and without images, a network, and a rig with extreme names and numbers."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.geometry import Array, se2, se3
from calgraph.result import (
    BoardOutline,
    BoardView,
    Calibration,
    CaptureRow,
    Edge,
    Evidence,
    FloorView,
    Pictures,
    SensorPose,
    Snapshot,
    Verdict,
    join_covariances,
)

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation of a camera facing along the robot's x."""


def sigma(translation: float, rotation: float) -> Array:
    covariance: Array = np.diag([translation**2] * 3 + [rotation**2] * 3)
    return covariance


def rig_of(sensors: dict[str, str]) -> Rig:
    entries: dict[str, Any] = {
        name: {"kind": kind, "topic": f"/{i}"} for i, (name, kind) in enumerate(sensors.items())
    }
    intrinsics = {"width": 1280, "height": 720, "K": [900.0, 900.0, 640.0, 360.0]}
    entries = {n: e | ({"intrinsics": intrinsics} if e["kind"] == "camera" else {}) for n, e in entries.items()}
    target = {"kind": "board", "size": [1.0, 0.8], "tags": [{"id": 3, "size": 0.3}]}
    return Rig.model_validate({"root": next(iter(sensors)), "target": target, "sensors": entries})


SENSORS = {
    "lidar": "lidar3d",
    "camera": "camera",
    "camera_rear": "camera",
    "laser": "lidar2d",
    "laser_low": "lidar2d",
}


@pytest.fixture
def rig() -> Rig:
    return rig_of(SENSORS)


@pytest.fixture
def calibration(rng: np.random.Generator) -> Calibration:
    turn = np.diag([-1.0, -1, 1])
    poses = {
        "lidar": np.eye(4),
        "camera": se3.pose(FORWARD, np.array([0.21, 0.06, -0.12])),
        "camera_rear": se3.pose(turn @ FORWARD, np.array([-0.25, -0.04, -0.1])),
        "laser": se3.pose(np.eye(3), np.array([0.3, 0.0, -0.45])),
        "laser_low": se3.pose(turn, np.array([-0.32, 0.02, -0.6])),
    }
    parents = {"camera": "lidar", "camera_rear": "lidar", "laser": "lidar", "laser_low": "laser"}
    covariances = {
        "lidar": np.zeros((6, 6)), "camera": sigma(0.0016, 0.0006), "camera_rear": sigma(0.0024, 0.0009),
        "laser": sigma(0.0031, 0.0011), "laser_low": np.diag([4e-6, 5e-6, 6.4e-3, 2e-4, 3e-4, 1e-6]),
    }  # fmt: skip
    weak = Verdict(
        "weak",
        "height (z) is known to ± 80 mm only: hold the board leaning, so that the scan crosses its slanted edges",
    )
    sensors = tuple(
        SensorPose(name, parents.get(name), f"{name}_link", SENSORS[name], poses[name],  # type: ignore[arg-type]
                   weak if name == "laser_low" else Verdict("good"),
                   clock_offset=0.0123 if name == "camera" else None,
                   clock_offset_stddev=0.0004 if name == "camera" else None)
        for name in SENSORS
    )  # fmt: skip

    def edge(a: str, b: str, n: int, kept: int, tree: bool, rms: float, note: str = "") -> Edge:
        return Edge(a, b, n, kept, tree, rng.normal(0, rms, kept), note)

    edges = (
        edge("lidar", "camera", 41, 40, True, 0.0039),
        edge("lidar", "camera_rear", 28, 27, True, 0.0046),
        edge("lidar", "laser", 33, 29, True, 0.0071),
        edge("laser", "laser_low", 12, 11, True, 0.0093),
        edge("camera", "laser", 30, 28, False, 0.0065),
        edge("lidar", "laser_low", 14, 9, False, 0.011),
        edge("camera", "laser_low", 3, 0, False, 0.0, "needs 5 captures, has 3"),
        edge("camera", "camera_rear", 0, 0, False, 0.0, "share no capture of the board"),
    )
    reasons = {
        "camera": ["no tag found in any image", "board not at rest: tags moved by 4.1 pixels"],
        "camera_rear": ["no tag found in any image"],
        "lidar": ["no plane patch of the board's size after background subtraction"],
        "laser": ["the scan plane misses the board", "line too short: 0.21 m"],
        "laser_low": ["the scan plane misses the board"],
    }
    chance = {"lidar": 0.95, "camera": 0.85, "camera_rear": 0.55, "laser": 0.65, "laser_low": 0.25}
    captures = []
    for n in range(48):
        for name in SENSORS:
            used = bool(rng.random() < chance[name])
            reason = "" if used else str(rng.choice(reasons[name]))
            start = 6.0 + 3.4 * n
            captures.append(
                CaptureRow(n, start, start + 2, name, used, reason, abs(rng.normal(0, 0.005)) if used else None)
            )
    outlines = []
    for n in range(48):
        bearing, radius = rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 4)
        center = np.array([radius * np.cos(bearing), radius * np.sin(bearing), rng.uniform(-0.5, 0.3)])
        right = np.array([-np.sin(bearing), np.cos(bearing), 0])
        up = np.array([0, 0, 1]) + rng.normal(0, 0.2, 3)
        corners = [center + 0.5 * x * right + 0.4 * y * up for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        outlines.append(BoardOutline(n, np.array(corners)))
    residuals = {
        "camera corners": rng.normal(0, 1.02, 3000),
        "plane-point 3-D": rng.standard_t(5, 9000),
        "plane-point 2-D": rng.normal(0, 0.8, 1200),
    }
    return Calibration(
        "lidar",
        sensors,
        join_covariances([covariances[name] for name in SENSORS]),
        evidence=Evidence(
            edges=edges, captures=tuple(captures), unconnected={}, residuals=residuals, estimator="bundle"
        ),
        pictures=Pictures(board_outlines=tuple(outlines)),
    )


PIXEL, RANGE = 0.4, 0.008
"""Noise of corners, px, and of points about the board, m."""


@pytest.fixture
def pictured(calibration: Calibration, rig: Rig, rng: np.random.Generator) -> Calibration:
    """The rig with board views, and images of the first twelve captures."""
    board = np.array([[-0.5, -0.4, 0], [0.5, -0.4, 0], [0.5, 0.4, 0], [-0.5, 0.4, 0]])
    outlines = tuple(
        BoardOutline(o.capture, se3.apply(board_pose(o), board), board=0)
        for o in calibration.pictures.board_outlines
    )
    views = tuple(view for o in outlines for sensor in calibration.sensors for view in _view(o, sensor, rig, rng))
    taken = tuple(_snapshot(n, s, outlines[n], rng) for n in range(12) for s in calibration.sensors)
    return dataclasses.replace(
        calibration,
        pictures=dataclasses.replace(
            calibration.pictures, board_outlines=outlines, board_views=views, snapshots=taken
        ),
    )


def board_pose(outline: BoardOutline) -> Array:
    corners = outline.corners
    x, up = corners[1] - corners[0], corners[3] - corners[0]
    x, z = x / np.linalg.norm(x), np.cross(x, up) / np.linalg.norm(np.cross(x, up))
    return se3.pose(np.column_stack([x, np.cross(z, x), z]), corners.mean(axis=0))


def _view(outline: BoardOutline, sensor: SensorPose, rig: Rig, rng: np.random.Generator) -> Iterator[BoardView]:
    T_sensor_board = se3.inverse(sensor.T_root_sensor) @ board_pose(outline)
    if sensor.kind == "camera":
        camera = rig.cameras()[sensor.name].intrinsics.to_camera()  # type: ignore[union-attr]
        pixels = camera.project(se3.apply(T_sensor_board, compute_landmarks(rig.boards[0]).corners.reshape(-1, 3)))
        if camera.contains(pixels).all():
            off = rng.normal(0, PIXEL, pixels.shape)
            yield BoardView(outline.capture, sensor.name, True, pixels + off, off)
    elif sensor.kind == "lidar3d" or outline.capture % 2:
        places = rng.uniform([-0.5, -0.4], [0.5, 0.4], (80, 2)) * ([1, 1] if sensor.kind == "lidar3d" else [1, 0])
        off = rng.normal(0, RANGE, 80)
        away = np.sign(T_sensor_board[:3, 2] @ T_sensor_board[:3, 3])
        measured = se3.apply(T_sensor_board, np.column_stack([places, away * off]))
        yield BoardView(outline.capture, sensor.name, True, measured, off)


def _snapshot(capture: int, sensor: SensorPose, outline: BoardOutline, rng: np.random.Generator) -> Snapshot:
    """A camera image is red; a scanner measures the board and a wall."""
    if sensor.kind == "camera":
        pixels = np.full((360, 640, 3), (40, 60, 200), dtype=np.uint8)
        image = cv2.imencode(".jpg", pixels)[1].tobytes()
        return Snapshot(capture, sensor.name, 0.1 * capture, image, width=1280, height=720)
    on_board = outline.corners[0] + rng.uniform(size=(150, 2)) @ (outline.corners[[1, 3]] - outline.corners[0])
    wall = np.column_stack([np.full(300, 5.0), rng.uniform(-4, 4, 300), rng.uniform(-1, 2, 300)])
    points = se3.apply(se3.inverse(sensor.T_root_sensor), np.concatenate([on_board, wall]))
    if sensor.kind == "lidar2d":
        points[:, 2] = 0
    return Snapshot(capture, sensor.name, 0.1 * capture, points=points.astype(np.float32))


EVIL = '<script>alert("1")</script> & <b>ümläut</b> 前 $root </style>'


@pytest.fixture
def ugly() -> Calibration:
    """Names with markup, a root with a long name, infinite and NaN numbers, sensors without a pose or captures."""
    root = "a_very_long_name_of_a_sensor_that_goes_on_and_on_and_on"
    lost = np.diag([1e6, np.inf, 1e-6, 10.0, 1e-6, 1e-6])
    sensors = (
        SensorPose(root, None, "x" * 80, "lidar2d", np.eye(4), Verdict("good")),
        SensorPose(EVIL, root, EVIL, "camera", se3.pose(np.eye(3), np.array([1e-9, -2, 30.0])),
                   Verdict("unobservable", f"x and y are not observable {EVIL}")),
        SensorPose("", EVIL, "", "lidar3d", np.eye(4), Verdict("weak")),
    )  # fmt: skip
    edges = (
        Edge(root, EVIL, 4, 4, True, np.array([np.nan, np.inf, 0.1, 2.0]), EVIL),
        Edge(EVIL, "", 2, 0, False, np.empty(0), EVIL),
        Edge(root, "gone", 2, 0, False, np.empty(0), "an edge to a sensor without a pose"),
    )
    captures = (
        CaptureRow(-1, np.nan, np.inf, EVIL, False, EVIL),
        CaptureRow(7, 0.0, 1e9, "never heard of", True, "", np.nan),
    )
    residuals = {
        EVIL: np.array([np.nan, 1.0, -2, 900]), "empty": np.empty(0), "all nan": np.full(3, np.nan),
        "zero": np.zeros(4),
    }  # fmt: skip
    outlines = (BoardOutline(0, np.full((4, 3), np.nan)),)
    return Calibration(
        root,
        sensors,
        join_covariances([np.zeros((6, 6)), lost, np.full((6, 6), np.nan)]),
        evidence=Evidence(
            edges=edges,
            captures=captures,
            unconnected={"gone": EVIL, EVIL + "2": ""},
            residuals=residuals,
            estimator=EVIL,
        ),
        pictures=Pictures(board_outlines=outlines),
    )


@pytest.fixture
def bare() -> Calibration:
    """A root and nothing else."""
    root = SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good"))
    return Calibration("lidar", (root,), np.zeros((6, 6)))


SCANNERS = {"hall": (0.0, 0.0, 0.0), "door <b>": (6.0, 1.0, 2.0), "stairs": (3.0, 7.0, -1.5)}
"""x, y (m) and yaw (rad) of a network's scanners."""


@pytest.fixture
def network_rig() -> Rig:
    sensors = {name: {"kind": "lidar2d", "topic": f"/{i}"} for i, name in enumerate(SCANNERS)}
    return Rig.model_validate({"root": "hall", "target": {"kind": "people"}, "sensors": sensors})


@pytest.fixture
def network() -> Calibration:
    """Three scanners on a floor, one without tracks, a walk along x = 2 m, and a wall along y = -1 m."""
    spread = np.full((6, 6), np.nan)
    spread[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([0.01**2, 0.02**2, 0.001**2])
    sensors = tuple(
        SensorPose(name, None if name == "hall" else "hall", name, "lidar2d",
                   se2.to_se3(se2.pose(yaw, np.array([x, y]))), Verdict("weak" if name == "stairs" else "good"))
        for name, (x, y, yaw) in SCANNERS.items()
    )  # fmt: skip
    edges = (
        Edge("hall", "door <b>", 340, 300, True, np.array([0.004])),
        Edge("hall", "stairs", 90, 60, True, np.array([0.02])),
        Edge("door <b>", "stairs", 50, 0, False, np.empty(0), "inconsistent with the other pairs"),
    )
    rows = (
        CaptureRow(0, 0.0, 4.0, "hall", True, "", 0.021),
        CaptureRow(1, 0.5, 4.5, "door <b>", True, "", 0.021),
        CaptureRow(2, 2.0, 3.0, "hall", False, "no other sensor detected a person at that time"),
    )
    wall, walk = np.linspace([0, -1], [8, -1], 50), np.linspace([2, 0], [2, 5], 40)
    floor = (FloorView("hall", wall, (walk, walk + 0.1)), FloorView("door <b>", wall, (walk,)))
    start = {
        name: se2.to_se3(se2.pose(yaw + 0.1, np.array([x, y + 0.5]))) for name, (x, y, yaw) in SCANNERS.items()
    }
    return Calibration(
        "hall",
        sensors,
        join_covariances([np.zeros((6, 6)), spread, spread]),
        evidence=Evidence(
            edges=edges,
            captures=rows,
            unconnected={"attic": ""},
            residuals={"positions": np.zeros(9)},
            estimator="averaging",
            initial_poses=start,
        ),
        pictures=Pictures(floor_views=floor),
    )

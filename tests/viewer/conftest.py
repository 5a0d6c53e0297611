"""A rig and a network that are small enough for hand-computed expectations."""

import cv2
import numpy as np
import pytest

from calgraph.geometry import Array, se2, se3
from calgraph.result import (
    BoardOutline,
    BoardView,
    Calibration,
    CaptureRow,
    Evidence,
    FloorView,
    Pictures,
    SensorPose,
    Snapshot,
    Verdict,
    join_covariances,
)
from calgraph.sensors import CameraModel

# A camera that looks along x of the root, from 0.5 m below it: its z is x of the root, its x is -y.
T_LIDAR_CAMERA = se3.pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=float), np.array([0, 0, -0.5]))
T_LIDAR_LASER = se3.pose(np.eye(3), np.array([0.3, 0.2, -0.4]))
CAMERA = CameraModel("pinhole", 640, 480, np.array([[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]), np.zeros(0))
SPREAD = np.diag([1e-3, 2e-3, 3e-3, 1e-3, 1e-3, 1e-3]) ** 2
SHEET = np.array([[0, 0.5, -0.4], [0, -0.5, -0.4], [0, -0.5, 0.4], [0, 0.5, 0.4]])
"""(4, 3) corners of a board that faces the rig, relative to its centre, m."""


def board_at(capture: int) -> Array:
    """(3,) the middle of the board, root frame, m."""
    return np.array([3.0 + 0.5 * capture, 0, -0.5])


def picture() -> bytes:
    """A JPEG, red on the left and green on the right, of half the camera's size."""
    pixels = np.zeros((240, 320, 3), np.uint8)
    pixels[:, :160, 2], pixels[:, 160:, 1] = 220, 220
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def patch(capture: int) -> Array:
    """(N, 3) points on the board in the root's frame, m."""
    y, z = np.meshgrid(np.linspace(-0.45, 0.45, 25), np.linspace(-0.35, 0.35, 20))
    return np.column_stack([np.zeros(y.size), y.ravel(), z.ravel()]) + board_at(capture)


def line(capture: int) -> Array:
    """(N, 3) points of the laser scanner on the board, in its frame, m."""
    y = np.linspace(-0.4, 0.4, 60)
    x_root = np.column_stack([np.full(60, board_at(capture)[0]), y, np.full(60, -0.4)])
    return se3.apply(se3.inverse(T_LIDAR_LASER), x_root)


def wall() -> Array:
    """(N, 3) points 6 m ahead of the root, m."""
    y, z = np.meshgrid(np.linspace(-4, 4, 60), np.linspace(-1, 2, 30))
    return np.column_stack([np.full(y.size, 6.0), y.ravel(), z.ravel()])


def corners(capture: int) -> Array:
    """(M, 2) pixels of points on the board."""
    return CAMERA.project(se3.apply(se3.inverse(T_LIDAR_CAMERA), patch(capture)[::50]))


@pytest.fixture(scope="session")
def rig() -> Calibration:
    """A LiDAR, a camera and a laser scanner that detect a board in three captures, without noise."""
    sensors = (
        SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good")),
        SensorPose("camera/front *1*", "lidar", "camera", "camera", T_LIDAR_CAMERA, Verdict("good")),
        SensorPose("laser", "lidar", "laser", "lidar2d", T_LIDAR_LASER, Verdict("good")),
    )
    snapshots, outlines, views, rows = [], [], [], []
    for k in range(3):
        cloud = np.concatenate([patch(k), wall()]).astype(np.float32)
        snapshots += [
            Snapshot(k, "lidar", 10.0 * k, points=cloud),
            Snapshot(k, "camera/front *1*", 10.0 * k, picture(), 640, 480),
            Snapshot(k, "laser", 10.0 * k, points=line(k).astype(np.float32)),
            Snapshot(k, "sonar", 10.0 * k, points=cloud),
        ]
        outlines.append(BoardOutline(k, board_at(k) + SHEET))
        pixels = corners(k)
        views += [
            BoardView(k, "lidar", True, patch(k), np.zeros(len(patch(k)))),
            BoardView(k, "camera/front *1*", True, pixels, np.zeros_like(pixels)),
            BoardView(k, "laser", True, line(k), np.zeros(60)),
        ]
        rows += [CaptureRow(k, 10.0 * k, 10.0 * k + 2, s.name, True, "", 0.0) for s in sensors]
    return Calibration(
        "lidar",
        sensors,
        join_covariances([np.zeros((6, 6)), SPREAD, SPREAD]),
        evidence=Evidence(captures=tuple(rows), unconnected={"sonar": "saw nothing"}, estimator="bundle"),
        pictures=Pictures(board_outlines=tuple(outlines), snapshots=tuple(snapshots), board_views=tuple(views)),
    )


@pytest.fixture(scope="session")
def cameras() -> dict[str, CameraModel]:
    return {"camera/front *1*": CAMERA}


T_A_B = se2.to_se3(se2.pose(np.pi / 2, np.array([6.0, 0.0])))


@pytest.fixture(scope="session")
def network() -> Calibration:
    """Two scanners in a hall; a person walks along x = 2 m for 9 s in view of both."""
    spread = np.zeros((6, 6))
    spread[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([0.01**2, 0.02**2, 0.001**2])
    sensors = (
        SensorPose("a", None, "a", "lidar2d", np.eye(4), Verdict("good")),
        SensorPose("b", "a", "b", "lidar2d", T_A_B, Verdict("good")),
    )
    hall = np.concatenate([np.linspace([-1, y], [7, y], 200) for y in (-1, 9)])
    walk, times = np.linspace([2, 0], [2, 9], 91), np.linspace(0, 9, 91)
    floor = (
        FloorView("a", hall, (walk,), (times,)),
        FloorView("b", hall + 0.01, (walk, walk), (times, times + 5)),
    )
    return Calibration(
        "a",
        sensors,
        join_covariances([np.zeros((6, 6)), spread]),
        evidence=Evidence(estimator="joint"),
        pictures=Pictures(floor_views=floor),
    )

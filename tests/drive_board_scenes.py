"""Two cameras on a robot that look apart, and boards that they pass."""

import numpy as np

from calgraph.drive.board_views import BoardView
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel

CAMERA = CameraModel(
    "pinhole",
    640,
    480,
    np.array([[420.0, 0, 322], [0, 424, 236], [0, 0, 1]]),
    np.array([-0.1, 0.02, 1e-3, -5e-4, 0.0]),
)
FISHEYE = CameraModel(
    "fisheye",
    640,
    480,
    np.array([[260.0, 0, 318], [0, 261, 241], [0, 0, 1]]),
    np.array([0.02, -0.01, 2e-3, -1e-4]),
)
# Optical axes ahead and to the left of the robot.
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MOUNTED = (
    se3.pose(so3.exp(np.array([0.0, 0.1, 0.3])) @ OPTICAL, np.array([0.3, 0.1, 0.4])),
    se3.pose(so3.exp(np.array([0.1, 0.0, 2.0])) @ OPTICAL, np.array([-0.2, 0.1, 0.6])),
)
CORNERS = np.array([[x, y, 0.0] for y in (0.2, 0.05, -0.1, -0.2) for x in (-0.25, -0.1, 0.0, 0.1, 0.25)])


def place_boards(poses: Array, count: int, rng: np.random.Generator) -> Array:
    """Poses (count, 4, 4) of boards some 2 m before each camera at times of the drive."""
    found = []
    for b in range(count):
        T = poses[int(rng.integers(len(poses)))] @ MOUNTED[b % 2]
        turn = so3.exp(rng.normal(0, 0.2, 3)) @ np.diag([1.0, -1, -1])
        found.append(T @ se3.pose(turn, np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.5, 2.5)])))
    return np.array(found)


def see(
    T_world_camera: Array, times: Array, boards: Array, camera: CameraModel, noise: float, rng: np.random.Generator
) -> list[BoardView]:
    """What a camera sees of boards at times."""
    views = []
    for time, T in zip(times, T_world_camera, strict=True):
        for b, T_world_board in enumerate(boards):
            T_camera_board = se3.inverse(T) @ T_world_board
            pixels = camera.project(se3.apply(T_camera_board, CORNERS))
            facing = T_camera_board[:3, 2] @ T_camera_board[:3, 3] < 0
            if facing and camera.contains(pixels).all() and np.linalg.norm(T_camera_board[:3, 3]) < 5:
                measured = pixels + rng.normal(0, noise, pixels.shape)
                views.append(BoardView(float(time), b, CORNERS, measured, T_camera_board))
    return views

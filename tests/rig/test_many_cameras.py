"""A ring of cameras whose lenses have a residual distortion each: a thousand parameters, in little memory."""

import tracemalloc

import numpy as np
import pytest

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Intrinsics, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import CameraModel

CAMERAS, CAPTURES, MODEL_ERROR = 6, 24, 0.05
SIZE = 1280, 960
NOISE = 0.2
"""Of corners, pixels."""
MIN_INCIDENCE = np.cos(np.radians(60))
"""Cosine of the largest angle at which a camera detects the board."""
MIN_CORNERS = 8


def make_rig(cameras: int) -> Rig:
    """The cameras and a ChArUco board of 1.0 x 0.7 m."""
    pattern = {"kind": "charuco", "columns": 10, "rows": 7, "square": 0.1, "marker": 0.075}
    target = {"kind": "board", "size": [1.0, 0.7], "pattern": {**pattern, "dictionary": "DICT_5X5_100"}}
    sensors = {f"camera_{i}": {"kind": "camera", "topic": f"/camera_{i}"} for i in range(cameras)}
    return Rig.model_validate({"root": "camera_0", "target": target, "sensors": sensors})


def look_at(position: Array, target: Array) -> Array:
    """(4, 4) pose of a camera at a position whose optical axis points at a target, with y downwards."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return se3.pose(np.column_stack([x, np.cross(z, x), z]), position)


def draw_cameras(count: int, radius: float, rng: np.random.Generator) -> tuple[Array, list[CameraModel]]:
    """Poses (S, 4, 4) in the middle's frame, and lenses."""
    poses, lenses = [], []
    for angle in 2 * np.pi * np.arange(count) / count:
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.8, 0.8)])
        poses.append(look_at(position, rng.uniform(-0.2, 0.2, 3)))
        f, (u, v) = rng.uniform(850, 1000), rng.uniform(-10, 10, 2)
        K = np.array([[f, 0, 639.5 + u], [0, f, 479.5 + v], [0, 0, 1]])
        lenses.append(CameraModel("pinhole", *SIZE, K, np.array([rng.uniform(-0.1, 0.1), 0.02, 0, 0, 0])))
    return np.array(poses), lenses


def view_boards(
    rig: Rig, T_world_camera: Array, lenses: list[CameraModel], captures: int, rng: np.random.Generator
) -> dict[str, dict[int, BoardView]]:
    """By camera and capture, the corners of the board that is turned to one camera after the other."""
    marks = compute_landmarks(rig.boards[0])
    corners = marks.corners[:, 0]
    views: dict[str, dict[int, BoardView]] = {name: {} for name in rig.sensors}
    for k in range(captures):
        center = rng.uniform([-0.5, -0.5, -0.4], [0.5, 0.5, 0.4])
        towards = T_world_camera[k % len(lenses), :3, 3] + rng.normal(size=3) * 0.8
        # The board's z axis points at the camera, its y axis up.
        T = look_at(center, towards) @ se3.pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        T = T @ se3.pose(so3.exp(np.array([0, 0, rng.normal() * 0.4])), np.zeros(3))
        for name, T_camera, lens in zip(rig.sensors, T_world_camera, lenses, strict=True):
            T_camera_board = se3.inverse(T_camera) @ T
            sight = T_camera_board[:3, 3] / np.linalg.norm(T_camera_board[:3, 3])
            if -sight @ T_camera_board[:3, 2] < MIN_INCIDENCE:
                continue
            pixels = lens.project(se3.apply(T_camera_board, corners)) + NOISE * rng.normal(size=(len(corners), 2))
            inside = lens.contains(pixels)
            if inside.sum() >= MIN_CORNERS:
                views[name][k] = BoardView(marks.ids[inside], marks.corners[inside], pixels[inside, None], SIZE)
    return views


@pytest.mark.slow
def test_a_ring_of_cameras_takes_less_memory_than_a_matrix_of_each_board_or_candidate() -> None:
    rng = np.random.default_rng(0)
    rig = make_rig(CAMERAS)
    T_world_camera, lenses = draw_cameras(CAMERAS, 2.5, rng)
    stated = {
        name: spec.model_copy(update={"intrinsics": Intrinsics.from_camera(lens, model_error=MODEL_ERROR)})
        for (name, spec), lens in zip(rig.sensors.items(), lenses, strict=True)
    }
    rig = rig.model_copy(update={"sensors": stated})
    cameras = dict(zip(rig.sensors, lenses, strict=True))
    views = view_boards(rig, T_world_camera, lenses, CAPTURES, rng)
    detections = {
        name: {
            k: make_board_corners(pose, view.corners, view.pixels)
            for k, view in of_camera.items()
            if not isinstance(
                pose := fit_pose(view.ids, view.corners, view.pixels, cameras[name], NOISE), Rejected
            )
        }
        for name, of_camera in views.items()
    }
    captures = captures_from_detections(rig, detections, cameras)
    problem = build_problem_from_captures(rig, captures, RigOptions(folds=0), np.random.default_rng(0))
    tracemalloc.start()
    try:
        calibration = solve_problem(problem)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # Information of 300 candidates on 800 parameters would be 1.6 GB.
    assert peak < 0.3e9
    assert calibration.evidence.suggestions
    errors = []
    for sensor, T in zip(calibration.sensors[1:], T_world_camera[1:], strict=True):
        e = se3.difference(sensor.T_root_sensor, se3.inverse(T_world_camera[0]) @ T)
        errors.append(e @ np.linalg.solve(sensor.covariance, e) / 6)
    # Of 30 correlated squares; few captures leave centimetres.
    assert 0.2 < np.mean(errors) < 2.0

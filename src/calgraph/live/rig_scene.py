"""The 3-D view of a rig's session: sensors with poses, and the boards of the captures."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.boards.detections import BoardCorners
from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.live.live_captures import LiveCapture
from calgraph.live.rig_solution import LiveSolution, SensorSolution
from calgraph.live.scene_view import SceneFrame, SceneView
from calgraph.sensors import CameraModel


def make_scene(
    rig: Rig, solution: LiveSolution, captures: Sequence[LiveCapture], cameras: Mapping[str, CameraModel]
) -> SceneView:
    """The sensors that have poses, and the board where a camera detected it, in the frame of the root.

    Args:
        rig: of the session.
        solution: the last one.
        captures: so far.
        cameras: intrinsics by camera.
    """
    poses = {one.name: one.T_root_sensor for one in solution.sensors if one.T_root_sensor is not None}
    frames = [_make_frame(rig, one, one.T_root_sensor, cameras) for one in solution.sensors if one.name in poses]
    boards = [board for capture in captures if (board := _locate_board(rig, capture, poses)) is not None]
    suggestion = solution.suggestion
    suggested = None if suggestion is None else _outline(rig.board_size, suggestion.T_root_board)
    return SceneView(frames, np.array(boards) if boards else np.zeros((0, 4, 3)), suggested)


def _make_frame(
    rig: Rig, sensor: SensorSolution, T_root_sensor: Array | None, cameras: Mapping[str, CameraModel]
) -> SceneFrame:
    assert T_root_sensor is not None
    R, variances = T_root_sensor[:3, :3], sensor.stddev[:3] ** 2
    camera = cameras.get(sensor.name)
    return SceneFrame(
        sensor.name,
        sensor.kind,
        T_root_sensor,
        None if sensor.name == rig.root else R @ np.diag(variances) @ R.T,
        sensor.grade,
        _measure_field_of_view(camera) if camera else None,
    )


def _measure_field_of_view(camera: CameraModel) -> tuple[float, float]:
    """Horizontal and vertical field of view, rad."""
    u, v = camera.principal_point
    rays = camera.rays(np.array([[0.0, v], [camera.width - 1.0, v], [u, 0.0], [u, camera.height - 1.0]]))
    left, right, top, bottom = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.arccos(left @ right)), float(np.arccos(top @ bottom))


def _locate_board(rig: Rig, capture: LiveCapture, poses: Mapping[str, Array]) -> Array | None:
    """(4, 3) corners of the board that a camera with a pose detected; None if none did."""
    for name, T_root_camera in poses.items():
        found = capture.detections[name]
        best = None if isinstance(found, Rejected) else found[0]
        if isinstance(best, BoardCorners):
            return _outline(rig.boards[best.board].size, T_root_camera @ best.T_camera_board)
    return None


def _outline(size: tuple[float, float], T_root_board: Array) -> Array:
    """(4, 3) corners of a board of a width and height, m."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [size[0] / 2, size[1] / 2, 0.0]
    return se3.apply(T_root_board, corners)

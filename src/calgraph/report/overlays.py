"""The overlay of a camera image: the board predicted by the joint solution, and the residuals of all sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.boards.landmarks import compute_landmarks
from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.result import BoardOutline, BoardView, Calibration, SensorPose
from calgraph.sensors import CameraModel

# Samples of a straight edge, which lenses bend.
_SAMPLES_PER_EDGE = 12
# Lines are clipped at this margin beyond the image, relative to its size, so that they reach its border.
_IMAGE_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class Overlay:
    """In pixels of the full image; NaN outside of the camera's view."""

    board_outlines: tuple[Array, ...]
    """(N, 2) outline of each board."""
    marks: tuple[Array, ...]
    """(N, 2) outline of each printed tag, or a single corner (1, 2)."""
    measured: Array
    """(M, 2) corners that the camera detected."""
    residuals: Array
    """(M, 2) measured minus predicted; NaN without a prediction."""
    points: Array
    """(P, 2) of scanners on the board."""
    distances: Array
    """(P,) signed distances of those points from the board's plane, m, positive behind it for the scanner."""


def compute_overlay(
    calibration: Calibration, rig: Rig, sensor: SensorPose, camera: CameraModel, capture: int
) -> Overlay:
    """Predictions and measurements of one capture in the image of one camera."""
    outlines = [
        o for o in calibration.pictures.board_outlines if o.capture == capture and np.isfinite(o.corners).all()
    ]
    views = [view for view in calibration.pictures.board_views if view.capture == capture]
    of_camera = [view for view in views if view.sensor == sensor.name]
    points, distance = _scanner_points(calibration, views)
    return Overlay(
        board_outlines=tuple(
            project_to_image(_sample_outline(o.corners), sensor, camera, _IMAGE_MARGIN) for o in outlines
        ),
        marks=tuple(mark for o in outlines for mark in _project_print(o, rig, sensor, camera)),
        measured=np.concatenate([np.zeros((0, 2)), *(view.measured for view in of_camera)]),
        residuals=np.concatenate([np.zeros((0, 2)), *(_residuals_or_nan(view) for view in of_camera)]),
        points=project_to_image(points, sensor, camera),
        distances=distance,
    )


def project_to_image(points: Array, sensor: SensorPose, camera: CameraModel, margin: float = 0.0) -> Array:
    """Pixels (N, 2) of points (N, 3) in the root frame, m.

    NaN behind the camera, and outside of the image by more than ``margin`` times its size.
    """
    pixels = camera.project(se3.apply(se3.inverse(sensor.T_root_sensor), points))
    share = (pixels + 0.5) / (camera.width, camera.height)
    inside = np.all((share >= -margin) & (share < 1 + margin), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _residuals_or_nan(view: BoardView) -> Array:
    return np.full_like(view.measured, np.nan) if view.residuals is None else view.residuals


def _sample_outline(corners: Array) -> Array:
    """(N, 3) points along the closed outline of corners (K, 3)."""
    t = np.linspace(0, 1, _SAMPLES_PER_EDGE, endpoint=False)[:, None, None]
    along = (1 - t) * corners + t * np.roll(corners, -1, axis=0)
    return np.concatenate([along.swapaxes(0, 1).reshape(-1, 3), corners[:1]])


def _project_print(outline: BoardOutline, rig: Rig, sensor: SensorPose, camera: CameraModel) -> Sequence[Array]:
    """Outlines (N, 2) of tags, or single corners (1, 2), in pixels; none without a camera's detection."""
    if outline.board is None or outline.board >= len(rig.boards):
        return ()
    marks = compute_landmarks(rig.boards[outline.board]).corners
    lines = [mark if len(mark) == 1 else _sample_outline(mark) for mark in marks]
    if not lines:
        return ()
    points = se3.apply(_board_pose(outline.corners), np.concatenate(lines))
    ends = np.cumsum([len(line) for line in lines])[:-1]
    return np.split(project_to_image(points, sensor, camera, _IMAGE_MARGIN), ends)


def _board_pose(corners: Array) -> Array:
    """``T_root_board`` (4, 4) of a board's corners (4, 3), counter-clockwise from the bottom left."""
    x, y = (side / np.linalg.norm(side) for side in (corners[1] - corners[0], corners[3] - corners[0]))
    return se3.pose(np.column_stack([x, y, np.cross(x, y)]), corners.mean(axis=0))


def _scanner_points(calibration: Calibration, views: Sequence[BoardView]) -> tuple[Array, Array]:
    """Points (P, 3) of scanners on the board in the root frame, and their distances (P,) from its plane, m."""
    poses = {s.name: s.T_root_sensor for s in calibration.sensors}
    used = [v for v in views if v.residuals is not None and v.residuals.ndim == 1 and v.sensor in poses]
    points = [se3.apply(poses[view.sensor], view.measured) for view in used]
    offs = [view.residuals for view in used if view.residuals is not None]
    return np.concatenate([np.zeros((0, 3)), *points]), np.concatenate([np.zeros(0), *offs])

"""What is drawn over a camera's picture: the board where the joint solution has it, and how far off all saw it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Rig
from calgraph.detection import compute_landmarks
from calgraph.geometry import Array, se3
from calgraph.result import BoardOutline, BoardView, Calibration, SensorPose
from calgraph.sensors import CameraModel

# Straight edges are bent by lenses: drawn in so many pieces.
_PIECES = 12
# Lines go on to the edge of the picture: their ends lie beyond it by such a share of its size.
_BEYOND = 0.5


@dataclass(frozen=True, eq=False)
class Overlay:
    """In the pixels of a camera's full picture; NaN where it does not see it."""

    sheets: tuple[Array, ...]
    """(N, 2) outline of each board."""
    marks: tuple[Array, ...]
    """(N, 2) outline of each printed tag, or a single corner (1, 2)."""
    seen: Array
    """(M, 2) corners that the camera saw."""
    off: Array
    """(M, 2) measured minus predicted; NaN where nothing is predicted."""
    points: Array
    """(P, 2) of scanners on the board."""
    distance: Array
    """(P,) of those points from the board's plane, m, positive beyond it as their scanner sees it."""


def overlay(calibration: Calibration, rig: Rig, sensor: SensorPose, camera: CameraModel, capture: int) -> Overlay:
    """What one camera should see in one capture, and what it and the scanners did."""
    outlines = [
        o for o in calibration.pictures.board_outlines if o.capture == capture and np.isfinite(o.corners).all()
    ]
    views = [view for view in calibration.pictures.board_views if view.capture == capture]
    own = [view for view in views if view.sensor == sensor.name]
    points, distance = _scanned(calibration, views)
    return Overlay(
        sheets=tuple(project(_edges(o.corners), sensor, camera, _BEYOND) for o in outlines),
        marks=tuple(project(mark, sensor, camera, _BEYOND) for o in outlines for mark in _printed(o, rig)),
        seen=np.concatenate([np.zeros((0, 2)), *(view.measured for view in own)]),
        off=np.concatenate([np.zeros((0, 2)), *(_off(view) for view in own)]),
        points=project(points, sensor, camera),
        distance=distance,
    )


def project(points: Array, sensor: SensorPose, camera: CameraModel, beyond: float = 0.0) -> Array:
    """Pixels (N, 2) of points (N, 3) in the root frame, m.

    NaN where the camera does not see them, and outside of the picture by more than a share of its size.
    """
    pixels = camera.project(se3.apply(se3.inverse(sensor.T_root_sensor), points))
    share = (pixels + 0.5) / (camera.width, camera.height)
    inside = np.all((share >= -beyond) & (share < 1 + beyond), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _off(view: BoardView) -> Array:
    return np.full_like(view.measured, np.nan) if view.residuals is None else view.residuals


def _edges(corners: Array) -> Array:
    """(N, 3) points along the closed outline of corners (K, 3)."""
    t = np.linspace(0, 1, _PIECES, endpoint=False)[:, None, None]
    along = (1 - t) * corners + t * np.roll(corners, -1, axis=0)
    return np.concatenate([along.swapaxes(0, 1).reshape(-1, 3), corners[:1]])


def _printed(outline: BoardOutline, rig: Rig) -> Sequence[Array]:
    """Outlines (N, 3) of tags, or single corners (1, 3), in the root frame; none where no camera saw the print."""
    if outline.board is None or outline.board >= len(rig.boards):
        return ()
    T_root_board = _pose(outline.corners)
    marks = compute_landmarks(rig.boards[outline.board]).corners
    return [se3.apply(T_root_board, mark if len(mark) == 1 else _edges(mark)) for mark in marks]


def _pose(corners: Array) -> Array:
    """``T_root_board`` (4, 4) of a sheet's corners (4, 3), anticlockwise from the bottom left."""
    x, y = (side / np.linalg.norm(side) for side in (corners[1] - corners[0], corners[3] - corners[0]))
    return se3.pose(np.column_stack([x, y, np.cross(x, y)]), corners.mean(axis=0))


def _scanned(calibration: Calibration, views: Sequence[BoardView]) -> tuple[Array, Array]:
    """Points (P, 3) of scanners on the board in the root frame, and their distances (P,) from its plane, m."""
    poses = {s.name: s.T_root_sensor for s in calibration.sensors}
    used = [v for v in views if v.residuals is not None and v.residuals.ndim == 1 and v.sensor in poses]
    points = [se3.apply(poses[view.sensor], view.measured) for view in used]
    offs = [view.residuals for view in used if view.residuals is not None]
    return np.concatenate([np.zeros((0, 3)), *points]), np.concatenate([np.zeros(0), *offs])

"""Residuals of each sensor's board detections against the joint solution if a sensor is displaced."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.geometry import Array, plane, se3
from calgraph.result import BoardOutline, Calibration
from calgraph.result.evidence import rms
from calgraph.sensors import CameraModel
from calgraph.viewer.view_state import ViewState, displaced_poses


@dataclass(frozen=True)
class Misalignment:
    """RMS residual of one sensor over the used captures."""

    rms: float
    unit: Literal["px", "m"]
    """px: reprojection error of a camera's corners; m: distance of a scanner's points from the board's plane."""

    def __str__(self) -> str:
        """The value with its unit."""
        return f"{self.rms:.2f} px" if self.unit == "px" else f"{1000 * self.rms:.1f} mm"


def compute_misalignments(
    calibration: Calibration, cameras: Mapping[str, CameraModel], state: ViewState
) -> dict[str, Misalignment]:
    """By sensor, at the selected moment; without sensors that have no used detection then."""
    T_root_moved = displaced_poses(calibration, state)
    outlines: dict[int, list[BoardOutline]] = {}
    for outline in calibration.pictures.board_outlines:
        outlines.setdefault(outline.capture, []).append(outline)
    off: dict[str, list[Array]] = {}
    for view in calibration.pictures.board_views:
        name, boards = view.sensor, outlines.get(view.capture, [])
        if boards and name in T_root_moved and state.moment in (None, view.capture):
            T, T_moved = calibration[name].T_root_sensor, T_root_moved[name]
            if view.residuals is not None and name in cameras:
                off.setdefault(name, []).append(
                    _corner_errors(view.measured, view.residuals, boards, cameras[name], T, T_moved)
                )
            elif view.residuals is not None and view.measured.shape[1] == 3:
                off.setdefault(name, []).append(_plane_distances(view.measured, boards, T, T_moved))
    together = {name: rms(np.concatenate(parts)) for name, parts in off.items()}
    return {
        name: Misalignment(value, "px" if name in cameras else "m")
        for name, value in together.items()
        if value is not None
    }


def _plane_distances(points: Array, boards: Sequence[BoardOutline], T: Array, T_moved: Array) -> Array:
    """(M,) distances of a displaced scanner's points (M, 3) from the board that they belong to, m."""
    centre = se3.apply(T, points).mean(axis=0)
    board = min(boards, key=lambda one: float(np.linalg.norm(one.corners.mean(axis=0) - centre)))
    return plane.distance(plane.fit(board.corners), se3.apply(T_moved, points))


def _corner_errors(
    measured: Array,
    residuals: Array,
    boards: Sequence[BoardOutline],
    camera: CameraModel,
    T: Array,
    T_moved: Array,
) -> Array:
    """(M,) reprojection errors of corners (M, 2) in a displaced camera, px.

    The corners' positions on the board follow from their reprojection in the camera at its calibrated pose.
    """
    rays = camera.rays(measured - residuals) @ T[:3, :3].T
    board = min(boards, key=lambda one: _sine_between(one.corners.mean(axis=0) - T[:3, 3], rays.mean(axis=0)))
    n, d = np.split(plane.fit(board.corners), [3])
    reach = -(n @ T[:3, 3] + d) / (rays @ n)
    x_root = T[:3, 3] + reach[:, None] * rays
    predicted = camera.project(se3.apply(se3.inverse(T_moved), x_root))
    return np.asarray(np.linalg.norm(measured - predicted, axis=1))


def _sine_between(towards: Array, sight: Array) -> float:
    """The sine of the angle between two directions (3,)."""
    return float(np.linalg.norm(np.cross(towards, sight)) / (np.linalg.norm(towards) * np.linalg.norm(sight)))

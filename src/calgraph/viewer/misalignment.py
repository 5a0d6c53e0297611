"""How far what sensors saw of the board is off where the others have it, if a sensor is moved."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calgraph.geometry import Array, plane, se3
from calgraph.result import BoardOutline, Calibration
from calgraph.result.evidence import rms
from calgraph.sensors import CameraModel
from calgraph.viewer.view_state import Choice, poses


@dataclass(frozen=True)
class Misfit:
    """How far off one sensor is, in captures that were used."""

    rms: float
    unit: Literal["px", "m"]
    """Of a camera, distances of corners in its picture; of a scanner, of points from the board's plane."""

    def __str__(self) -> str:
        """The misfit as a person reads it."""
        return f"{self.rms:.2f} px" if self.unit == "px" else f"{1000 * self.rms:.1f} mm"


def misfits(calibration: Calibration, cameras: Mapping[str, CameraModel], choice: Choice) -> dict[str, Misfit]:
    """By sensor, at the moment chosen; none of those of which nothing was used then."""
    T_root_moved = poses(calibration, choice)
    sheets: dict[int, list[BoardOutline]] = {}
    for outline in calibration.pictures.board_outlines:
        sheets.setdefault(outline.capture, []).append(outline)
    off: dict[str, list[Array]] = {}
    for view in calibration.pictures.board_views:
        name, boards = view.sensor, sheets.get(view.capture, [])
        if boards and name in T_root_moved and choice.moment in (None, view.capture):
            T, T_moved = calibration[name].T_root_sensor, T_root_moved[name]
            if view.residuals is not None and name in cameras:
                off.setdefault(name, []).append(
                    _in_picture(view.measured, view.residuals, boards, cameras[name], T, T_moved)
                )
            elif view.residuals is not None and view.measured.shape[1] == 3:
                off.setdefault(name, []).append(_from_plane(view.measured, boards, T, T_moved))
    together = {name: rms(np.concatenate(parts)) for name, parts in off.items()}
    return {
        name: Misfit(value, "px" if name in cameras else "m")
        for name, value in together.items()
        if value is not None
    }


def _from_plane(seen: Array, boards: Sequence[BoardOutline], T: Array, T_moved: Array) -> Array:
    """(M,) distances of a moved scanner's points (M, 3) from the board that they lay on before it was moved, m."""
    centre = se3.apply(T, seen).mean(axis=0)
    board = min(boards, key=lambda one: float(np.linalg.norm(one.corners.mean(axis=0) - centre)))
    return plane.distance(plane.fit(board.corners), se3.apply(T_moved, seen))


def _in_picture(
    seen: Array, off: Array, boards: Sequence[BoardOutline], camera: CameraModel, T: Array, T_moved: Array
) -> Array:
    """(M,) distances of corners (M, 2) from where a moved camera would see them, px.

    Where they are on the board follows from where the camera would see them if it were not moved.
    """
    sights = camera.rays(seen - off) @ T[:3, :3].T
    board = min(boards, key=lambda one: _beside(one.corners.mean(axis=0) - T[:3, 3], sights.mean(axis=0)))
    n, d = np.split(plane.fit(board.corners), [3])
    reach = -(n @ T[:3, 3] + d) / (sights @ n)
    x_root = T[:3, 3] + reach[:, None] * sights
    predicted = camera.project(se3.apply(se3.inverse(T_moved), x_root))
    return np.asarray(np.linalg.norm(seen - predicted, axis=1))


def _beside(towards: Array, sight: Array) -> float:
    """The sine of the angle between two directions (3,)."""
    return float(np.linalg.norm(np.cross(towards, sight)) / (np.linalg.norm(towards) * np.linalg.norm(sight)))

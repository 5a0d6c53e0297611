"""The 3-D view of the page: sensors, boards of the captures, and the suggested board, as JSON."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """One sensor with a pose."""

    name: str
    kind: str
    """camera, lidar2d or lidar3d: a camera is drawn as a frustum along z, scanners as a disc around z."""
    T_root_sensor: NDArray[np.float64]
    """(4, 4)."""
    covariance: NDArray[np.float64] | None = None
    """(3, 3) of the position in the root frame, m^2; drawn as an ellipsoid. None for the root."""
    grade: str = ""
    """good, weak or unobservable."""
    field_of_view: tuple[float, float] | None = None
    """Of a camera: horizontal and vertical, rad; None where its intrinsics are unknown."""


@dataclass(frozen=True, eq=False)
class SceneView:
    """The 3-D view at one moment; coordinates in the root frame, m."""

    frames: Sequence[SceneFrame]
    boards: NDArray[np.float64]
    """(N, 4, 3): corners of the board in each capture, in order around its outline."""
    suggested: NDArray[np.float64] | None = None
    """(4, 3): where the board should be next."""


def encode_scene(scene: SceneView) -> bytes:
    """The scene as JSON that the page reads.

    ``{"frames": [{"name", "kind", "pose": 4x4, "covariance": 3x3 or null, "grade", "field_of_view": [h, v] or
    null}], "boards": [4x3, ...], "suggested": 4x3 or null}``, numbers with four decimals. A frame or board with
    a number that is not finite is left out.
    """
    frames = [
        {
            "name": frame.name,
            "kind": frame.kind,
            "pose": _round(frame.T_root_sensor),
            # Variances of some mm^2 need more decimals than positions.
            "covariance": None if frame.covariance is None else _round(frame.covariance, 10),
            "grade": frame.grade,
            "field_of_view": frame.field_of_view,
        }
        for frame in scene.frames
        if _is_finite(frame.T_root_sensor)
        and (frame.covariance is None or _is_finite(frame.covariance))
        and (frame.field_of_view is None or all(map(math.isfinite, frame.field_of_view)))
    ]
    boards = [_round(board) for board in scene.boards if _is_finite(board)]
    suggested = None if scene.suggested is None or not _is_finite(scene.suggested) else _round(scene.suggested)
    text = json.dumps({"frames": frames, "boards": boards, "suggested": suggested}, allow_nan=False)
    return text.encode()


def _is_finite(values: NDArray[np.float64]) -> bool:
    return bool(np.all(np.isfinite(values)))


def _round(values: NDArray[np.float64], decimals: int = 4) -> list[list[float]]:
    rows: list[list[float]] = np.round(np.asarray(values, dtype=float), decimals).tolist()
    return rows

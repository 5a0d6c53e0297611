"""Views of a checkerboard by a camera, as corners in pixels, without images."""

import numpy as np

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.rig.detection.board_views import BoardView
from calgraph.sensors import CameraModel

PINHOLE = CameraModel(
    "pinhole",
    1280,
    960,
    np.array([[640, 0, 655], [0, 641, 470], [0, 0, 1]]),
    np.array([-0.25, 0.08, 1e-3, -5e-4, -0.01]),
)
"""90 degrees wide."""
WIDE = CameraModel(
    "pinhole",
    1280,
    960,
    np.array([[448, 0, 655], [0, 449, 470], [0, 0, 1]]),
    np.array([-0.2, 0.04, 1e-3, -5e-4, -0.003]),
)
"""110 degrees wide."""
FISHEYE = CameraModel(
    "fisheye",
    1280,
    960,
    np.array([[380, 0, 655], [0, 381, 470], [0, 0, 1]]),
    np.array([-0.02, 0.008, -0.004, 5e-4]),
)
"""190 degrees wide."""


def checkerboard_rig(**camera: object) -> Rig:
    """A rig of one camera and a board of 8 by 6 corners, whose print is exact."""
    exact = {"print_scale": 0.0, "print_aspect": 0.0, "bow": 0.0}
    return Rig.model_validate({
        "root": "camera",
        "target": {
            "kind": "board",
            "size": [1.0, 0.8],
            "pattern": {"kind": "checkerboard", "columns": 8, "rows": 6, "square": 0.11},
            "uncertainty": exact,
        },
        "sensors": {"camera": {"kind": "camera", "topic": "/image", **camera}},
    })  # fmt: skip


def simulate_views(
    camera: CameraModel,
    seed: int,
    count: int = 25,
    *,
    noise: float = 0.2,
    tilt: float = 40.0,
    extent: float = 0.95,
    outliers: float = 0.0,
) -> list[BoardView]:
    """Views of a board at random places of the image.

    Args:
        camera: the true one.
        seed: of places and noise.
        count: of views.
        noise: standard deviation of corners, pixels.
        tilt: largest angle between the board and the line of sight's normal plane, degrees.
        extent: share of the image over which the middles of boards are spread.
        outliers: share of corners that are anywhere within 30 pixels.
    """
    rng = np.random.default_rng(seed)
    marks = compute_landmarks(checkerboard_rig().boards[0])
    size = np.array([camera.width, camera.height])
    views: list[BoardView] = []
    while len(views) < count:
        ray = camera.rays(((size - 1) / 2 + extent * rng.uniform(-0.5, 0.5, 2) * size)[None])[0]
        if not np.isfinite(ray).all():
            continue
        T = _face_camera(ray * rng.uniform(0.7, 2.5), rng.uniform(-tilt, tilt), rng)
        pixels = camera.project(se3.apply(T, marks.corners[:, 0]))
        inside = camera.contains(pixels)
        if inside.sum() < 12 or T[:3, 2] @ T[:3, 3] > -0.1:
            continue
        measured = pixels[inside] + noise * rng.standard_normal((int(inside.sum()), 2))
        wrong = rng.random(len(measured)) < outliers
        measured[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
        views.append(
            BoardView(marks.ids[inside], marks.corners[inside], measured[:, None], (camera.width, camera.height))
        )
    return views


def _face_camera(center: Array, tilt: float, rng: np.random.Generator) -> Array:
    """The pose of a board that faces the camera but for a tilt (degrees) about a random axis near its plane."""
    normal = -center / np.linalg.norm(center)
    x = np.cross(normal, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    axis = rng.standard_normal(3) * [1, 1, 0.3]
    R = np.column_stack([x, np.cross(normal, x), normal])
    return se3.pose(R @ so3.exp(np.radians(tilt) * axis / np.linalg.norm(axis)), center)

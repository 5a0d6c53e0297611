"""Random lenses, and views of a board through them, from exact corners.

Pinholes of 40 to 120 degrees and fisheyes of 90 to 190 degrees over the image's width, in turn, with random
distortion and principal point, and a checkerboard of 8 by 6 corners at random places, with a noise of 0.2 px. The
warp is one of three kinds: waves along and across the radius, bumps of random places and widths, or (of the size
of the warp, too) shear along the image's rows and columns that grows with the cube of the distance. It has no
part that a model describes only by chance.
"""

from collections.abc import Callable

import numpy as np

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.rig.detection.board_views import BoardView
from calgraph.sensors import CameraModel

SIZE, NOISE = (1280, 960), 0.2
RIG = Rig.model_validate({
    "root": "camera",
    "target": {
        "kind": "board",
        "size": [1.0, 0.8],
        "pattern": {"kind": "checkerboard", "columns": 8, "rows": 6, "square": 0.11},
    },
    "sensors": {"camera": {"kind": "camera", "topic": "/image"}},
})  # fmt: skip


def draw_lens(seed: int) -> CameraModel:
    """A pinhole or, of odd seeds, a fisheye."""
    rng = np.random.default_rng([seed, 3])
    center = np.array(SIZE) / 2 + rng.uniform(-20, 20, 2)
    if seed % 2:
        focal = SIZE[0] / np.radians(rng.uniform(90, 190))
        k = rng.normal(0, [0.02, 0.008, 0.003, 0.001])
        K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
        return CameraModel("fisheye", *SIZE, K, k)
    angle = rng.uniform(40, 120)
    focal = SIZE[0] / 2 / np.tan(np.radians(angle / 2))
    barrel = rng.uniform(0, 0.25)
    k = np.array([-barrel, 0.3 * barrel**2 / 0.25, *rng.normal(0, 5e-4, 2), -0.04 * barrel])
    if angle > 90:
        k[[0, 1, 4]] *= (np.tan(np.pi / 4) / np.tan(np.radians(angle / 2))) ** np.array([2, 4, 6])
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    return CameraModel("pinhole", *SIZE, K, k)


def simulate_views(camera: CameraModel, seed: int, count: int, warp: float) -> list[BoardView]:
    """Views of the board, tilted by up to 45 degrees, at random places that are at least half in the image."""
    rng = np.random.default_rng([seed, 5])
    marks = compute_landmarks(RIG.boards[0])
    displace = _draw_warp(rng, camera, warp)
    views: list[BoardView] = []
    while len(views) < count:
        ray = camera.rays(rng.uniform([0, 0], SIZE)[None])[0]
        if not np.isfinite(ray).all():
            continue
        distance = rng.uniform(0.7, 2.0) * camera.focal.mean() / 640
        T = _face_camera(ray * max(distance, 0.5), np.radians(rng.uniform(-45, 45)), rng)
        pixels = camera.project(se3.apply(T, marks.corners.reshape(-1, 3)))
        inside = np.isfinite(pixels).all(axis=-1) & camera.contains(pixels)
        if inside.mean() < 0.5:
            continue
        pixels = pixels[inside]
        pixels = pixels + displace(pixels) + rng.normal(0, NOISE, pixels.shape)
        corners = marks.corners.reshape(-1, 3)[inside]
        views.append(BoardView(np.flatnonzero(inside), corners[:, None], pixels[:, None], SIZE))
    return views


def _face_camera(center: Array, tilt: float, rng: np.random.Generator) -> Array:
    """A board at a place, tilted from the line of sight about a random axis, and turned about its normal by it."""
    sight = -center / np.linalg.norm(center)
    across = np.cross(sight, rng.normal(size=3))
    across /= np.linalg.norm(across)
    normal = so3.exp(tilt * across) @ sight
    x = np.cross(rng.normal(size=3), normal)
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, np.cross(normal, x), normal], axis=-1), center)


def _draw_warp(rng: np.random.Generator, camera: CameraModel, size: float) -> Callable[[Array], Array]:
    """A function from pixels (N, 2) to displacements (N, 2) of at most ``size``."""
    kind, diagonal = int(rng.integers(3)), float(np.hypot(*SIZE))
    periods, phases = rng.uniform(1, 4, 2), rng.uniform(0, 2 * np.pi, 2)
    places, widths = rng.uniform([0, 0], SIZE, (6, 2)), rng.uniform(0.08, 0.3, 6) * diagonal
    heights = rng.normal(size=(6, 2))
    grid = np.stack(np.meshgrid(*(np.linspace(0, side, 40) for side in SIZE)), axis=-1).reshape(-1, 2)

    def shape(pixels: Array) -> Array:
        away = (pixels - camera.principal_point) / (diagonal / 2)
        radius = np.linalg.norm(away, axis=-1, keepdims=True)
        if kind == 0:
            waves = np.sin(2 * np.pi * periods * radius + phases) * [1, 0.5]
            unit = away / np.maximum(radius, 1e-9)
            return np.asarray(radius * (waves[:, :1] * unit + waves[:, 1:] * unit[:, ::-1] * [-1, 1]))
        if kind == 1:
            squared = np.sum((pixels[:, None] - places) ** 2, axis=-1)
            return np.asarray(np.exp(-0.5 * squared / widths**2) @ heights)
        return np.asarray(away[:, ::-1] ** 3 * heights[0] + away**4 * heights[1])

    largest = np.linalg.norm(shape(grid), axis=-1).max()
    return lambda pixels: np.asarray(size / largest * shape(pixels))

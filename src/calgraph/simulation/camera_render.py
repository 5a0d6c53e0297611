"""Camera images of the board, the operator and the room, for every lens a camera model can describe.

Rays of pixels are intersected with the board and its printed face is sampled there. This is exact for any
distortion, where MSG-Cal's homography (section VI-B) needs a pinhole.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel
from calgraph.simulation.scene import Solid, cast

Gray = NDArray[np.float32]

_COARSE = 4
"""Step of the pixel grid on which the surroundings are drawn and the board is looked for."""
_SUBPIXELS = 3
"""Samples along each side of a pixel."""
_INK, _PAPER = 25.0, 225.0
"""Grey values of the print in full light."""
_BACK = 110.0
"""Grey value of the sheet's unprinted back."""


@dataclass(frozen=True, eq=False)
class PrintedBoard:
    """A board's face at resolutions halving from level to level, ready to be sampled."""

    size: tuple[float, float]
    """Width and height of the sheet, m."""
    levels: tuple[NDArray[np.uint8], ...]
    """(rows, columns, 2) each: reflectance and coverage, 0 to 255."""


@dataclass(frozen=True, eq=False)
class Darkroom:
    """What stays the same from image to image of one camera: its rays and the picture of the empty room."""

    camera: CameraModel
    T_world_camera: Array
    """(4, 4)."""
    rays: Array
    """(height, width, 3) unit vectors in the camera frame, NaN where the lens sees nothing."""
    background: Gray
    """(height, width) grey values of the empty room."""


def printed_board(face: Array, size: tuple[float, float]) -> PrintedBoard:
    """Prepares a face from :func:`calgraph.simulation.board_texture.board_texture` for rendering."""
    levels = []
    while True:
        coverage = np.full_like(face, 255)
        levels.append(np.stack([255 * face, coverage], axis=-1).round().astype(np.uint8))
        if min(face.shape) < 32:
            return PrintedBoard(size, tuple(levels))
        rows, columns = face.shape[0] // 2, face.shape[1] // 2
        face = np.asarray(cv2.resize(face, (columns, rows), interpolation=cv2.INTER_AREA))


def darkroom(
    camera: CameraModel, T_world_camera: Array, room: Sequence[Solid], rng: np.random.Generator
) -> Darkroom:
    """Casts the rays of all pixels and draws the empty room with a random texture on its surfaces."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    rays = camera.rays(pixels).reshape(camera.height, camera.width, 3)
    coarse = rays[::_COARSE, ::_COARSE]
    gray, _ = _shade(coarse, T_world_camera, room)
    gray = gray * (1 + 0.25 * _marbling(coarse, T_world_camera, room, rng))
    return Darkroom(camera, T_world_camera, rays, _enlarge(gray, camera))


def render(
    room: Darkroom, T_world_board: Array, board: PrintedBoard, operator: Sequence[Solid], blur: float
) -> Gray:
    """One image without noise: (height, width) grey values 0 to 255.

    Args:
        room: the camera with its cached rays and background.
        T_world_board: (4, 4).
        board: the printed board.
        operator: the person behind it.
        blur: standard deviation of the lens' point spread, pixels; 0 for none.

    """
    image = _with_solids(room, operator)
    _draw_board(image, room, T_world_board, board)
    return blurred(image, blur)


def blurred(image: Gray, blur: float) -> Gray:
    """The image seen through a lens with a Gaussian point spread of the given standard deviation, pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur)) if blur > 0 else image


@dataclass(frozen=True, eq=False)
class Grain:
    """A sheet of sensor noise larger than the image; every image gets another piece of it.

    Drawing 1.2 million normals for each image would take longer than rendering it; pieces shifted at random
    are as good as independent to anything that looks at single corners.
    """

    sheet: NDArray[np.int8]

    def add(self, image: Gray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The image with noise, as the 8 bits that a camera delivers."""
        height, width = image.shape
        row, column = rng.integers(0, np.array(self.sheet.shape) - (height, width) + 1)
        piece = self.sheet[row : row + height, column : column + width]
        noisy = cv2.add(image, piece, dtype=cv2.CV_8U)
        return np.asarray(noisy, dtype=np.uint8)


def grain(camera: CameraModel, sigma: float, rng: np.random.Generator) -> Grain:
    """Noise of the given standard deviation in grey values."""
    shape = (camera.height + 256, camera.width + 256)
    noise = sigma * rng.standard_normal(shape, dtype=np.float32)
    return Grain(np.clip(noise.round(), -127, 127).astype(np.int8))


def _draw_board(image: Gray, room: Darkroom, T_world_board: Array, board: PrintedBoard) -> None:
    """Draws the sheet over the image, in place."""
    T_board_camera = se3.inverse(T_world_board) @ room.T_world_camera
    window = _window(room, T_board_camera, board.size)
    if window is None:
        return
    rows, columns = window
    xy, seen = _on_sheet(room.rays[rows, columns], T_board_camera)
    seen &= (np.abs(xy) < board.size).all(axis=-1)
    # The neighbours of a pixel that misses are of no use for interpolation, and far off the sheet.
    seen = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    reflectance, coverage = np.moveaxis(_sample(board, np.where(seen[..., None], xy, 0)), -1, 0)
    reflectance, coverage = reflectance * seen, coverage * seen
    in_front = T_board_camera[2, 3] > 0
    light = _light(T_world_board[:3, 2] if in_front else -T_world_board[:3, 2])
    face = _INK * coverage + (_PAPER - _INK) * reflectance if in_front else _BACK * coverage
    image[rows, columns] = image[rows, columns] * (1 - coverage) + light * face


def _window(room: Darkroom, T_board_camera: Array, size: tuple[float, float]) -> tuple[slice, slice] | None:
    """The rows and columns that the sheet appears in, found on the coarse grid."""
    xy, seen = _on_sheet(room.rays[::_COARSE, ::_COARSE], T_board_camera)
    hit = seen & (np.abs(xy) <= np.array(size) / 2).all(axis=-1)
    if not hit.any():
        return None
    spans = []
    for axis, length in ((1, hit.shape[0]), (0, hit.shape[1])):
        where = np.flatnonzero(hit.any(axis=axis))
        # Two more steps: the sheet's corner may lie between grid points, and erosion takes a pixel.
        spans.append(slice(_COARSE * max(where[0] - 2, 0), _COARSE * min(where[-1] + 3, length)))
    return spans[0], spans[1]


def _on_sheet(rays: Array, T_board_camera: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where rays (..., 3) in the camera frame meet the board's plane: x and y (..., 2), and which do at all."""
    R, t = T_board_camera[:3, :3], T_board_camera[:3, 3]
    d = rays @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        s = -t[2] / d[..., 2]
        xy = t[:2] + s[..., None] * d[..., :2]
    seen = np.isfinite(xy).all(axis=-1) & (s > 0)
    return np.where(seen[..., None], xy, np.inf), seen


def _sample(board: PrintedBoard, xy: Array) -> Array:
    """Reflectance and coverage (rows, columns, 2), 0 to 1, averaged over the area of each pixel."""
    width, height = board.size
    texels = board.levels[0].shape[1] / width
    pixel = np.median(np.abs(np.diff(xy[..., 0], axis=1)) + np.abs(np.diff(xy[..., 1], axis=1)))
    level = int(np.clip(np.log2(max(texels * pixel / _SUBPIXELS, 1.0)), 0, len(board.levels) - 1))
    texture = board.levels[level]
    u = (xy[..., 0] / width + 0.5) * texture.shape[1] - 0.5
    v = (0.5 - xy[..., 1] / height) * texture.shape[0] - 0.5
    shape = (_SUBPIXELS * xy.shape[1], _SUBPIXELS * xy.shape[0])
    u, v = (cv2.resize(m.astype(np.float32), shape, interpolation=cv2.INTER_LINEAR) for m in (u, v))
    samples = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0))
    means = cv2.resize(samples, (xy.shape[1], xy.shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(means, dtype=np.float64) / 255


def _with_solids(room: Darkroom, solids: Sequence[Solid]) -> Gray:
    """A copy of the background with solids drawn on it, at the coarse resolution."""
    gray, hit = _shade(room.rays[::_COARSE, ::_COARSE], room.T_world_camera, solids)
    if not hit.any():
        return room.background.copy()
    mask = _enlarge(hit.astype(np.float64), room.camera)
    return room.background * (1 - mask) + _enlarge(gray, room.camera) * mask


def _shade(rays: Array, T_world_camera: Array, solids: Sequence[Solid]) -> tuple[Array, NDArray[np.bool_]]:
    """Grey values of the solids that rays (rows, columns, 3) hit, 0 where none, and which hit one."""
    hits = cast(solids, T_world_camera[:3, 3], _in_world(rays, T_world_camera))
    brightness = np.array([*(solid.brightness for solid in solids), 0.0])
    gray = brightness[hits.solid] / (1 + 0.08 * np.where(np.isfinite(hits.ranges), hits.ranges, 0))
    return gray.reshape(rays.shape[:2]), (hits.solid >= 0).reshape(rays.shape[:2])


def _marbling(rays: Array, T_world_camera: Array, solids: Sequence[Solid], rng: np.random.Generator) -> Array:
    """A smooth random pattern in space of about unit amplitude, where the rays meet the solids."""
    directions = _in_world(rays, T_world_camera)
    ranges = cast(solids, T_world_camera[:3, 3], directions).ranges
    points = T_world_camera[:3, 3] + np.where(np.isfinite(ranges), ranges, 0)[:, None] * directions
    waves = rng.standard_normal((3, 12)) * np.geomspace(2, 30, 12)
    pattern = np.sin(points @ waves + rng.uniform(0, 2 * np.pi, 12)).sum(axis=1) / np.sqrt(12)
    return np.asarray(pattern.reshape(rays.shape[:2]))


def _in_world(rays: Array, T_world_camera: Array) -> Array:
    """Rays as (N, 3) in the world frame; those of blind pixels point into the sky and hit little."""
    directions = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T
    return np.where(np.isfinite(directions), directions, [0.0, 0.0, 1.0])


def _light(normal: Array) -> float:
    """How brightly a surface is lit: lamps hang under the ceiling, the rest is diffuse."""
    return float(0.62 + 0.38 * max(normal @ np.array([0.0, 0.0, 1.0]), 0) + 0.2 * (1 - abs(normal[2])))


def _enlarge(coarse: Array, camera: CameraModel) -> Gray:
    """A picture drawn on the coarse grid at the camera's full size."""
    shape = (_COARSE * coarse.shape[1], _COARSE * coarse.shape[0])
    full = cv2.resize(coarse.astype(np.float32), shape, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[: camera.height, : camera.width])

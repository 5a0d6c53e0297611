"""Rendering of camera images of the board, the operator and the room, for any camera model.

The rays of pixels are intersected with the board and its printed face is sampled there. This is exact for any
distortion, whereas MSG-Cal's homography (section VI-B) needs a pinhole.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.config import Board, PrintedBitmap, printed_bitmaps
from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel, Image
from calgraph.simulation.robot import MountedDepthCamera
from calgraph.simulation.solids import Solid, Surface, cast_rays

Gray = NDArray[np.float32]
Visible = Solid | Surface

_COARSE_STEP = 4
"""Step of the pixel grid on which the environment is drawn and the board is searched, pixels."""
_SUBPIXELS = 2
"""Texture samples along each side of a pixel."""
_MAX_DISTANCE = 1e3
"""Positions in the board's plane are clipped at this distance, m."""
_INK_GRAY, _PAPER_GRAY = 25.0, 225.0
"""Grey values of the print under full illumination."""
_BACK_GRAY = 110.0
"""Grey value of the board's unprinted back."""


@dataclass(frozen=True, eq=False)
class PrintedBoard:
    """A board's face as an image pyramid, each level with half the resolution of the one before."""

    size: tuple[float, float]
    """Width and height of the board, m."""
    levels: tuple[NDArray[np.uint8], ...]
    """(rows, columns) each: reflectance, 0 to 255."""


@dataclass(frozen=True, eq=False)
class RenderContext:
    """What is common to all images of one camera: its rays and the image of the empty room."""

    T_world_camera: Array
    """(4, 4)."""
    rays: Gray
    """(3, height, width) unit vectors in the camera frame, NaN outside of the lens' field of view."""
    coarse_rays: Array
    """(rows, columns, 3) every fourth of them in the world frame; those without a ray point upwards."""
    background: Gray
    """(height, width) grey values of the empty room."""


def build_texture_pyramid(face: Array, size: tuple[float, float]) -> PrintedBoard:
    """Builds the image pyramid of a face from :func:`render_board_texture`."""
    levels = [face]
    while min(levels[-1].shape) >= 32:
        rows, columns = levels[-1].shape
        half = cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.float64))
    return PrintedBoard(size, tuple((255 * level).round().astype(np.uint8) for level in levels))


def build_render_context(
    camera: CameraModel, T_world_camera: Array, environment: Sequence[Visible], rng: np.random.Generator
) -> RenderContext:
    """Casts the rays of all pixels and renders the empty room with a random texture on its surfaces."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    rays = camera.rays(pixels).reshape(camera.height, camera.width, 3)
    coarse = rays[::_COARSE_STEP, ::_COARSE_STEP] @ T_world_camera[:3, :3].T
    coarse = np.where(np.isfinite(coarse), coarse, [0.0, 0.0, 1.0])
    planes = np.ascontiguousarray(np.moveaxis(rays, -1, 0), dtype=np.float32)
    background = _render_room(coarse, T_world_camera, environment, planes.shape[1:], rng)
    return RenderContext(T_world_camera, planes, coarse, background)


def move_render_context(
    context: RenderContext, T_world_camera: Array, environment: Sequence[Visible], rng: np.random.Generator
) -> RenderContext:
    """The context of a camera that has moved; with an equal generator, surfaces have equal textures."""
    coarse = context.coarse_rays @ (T_world_camera[:3, :3] @ context.T_world_camera[:3, :3].T).T
    background = _render_room(coarse, T_world_camera, environment, context.background.shape, rng)
    return RenderContext(T_world_camera, context.rays, coarse, background)


def _render_room(
    coarse: Array,
    T_world_camera: Array,
    environment: Sequence[Visible],
    shape: tuple[int, ...],
    rng: np.random.Generator,
) -> Gray:
    """The image (height, width) of a room with a random texture, by coarse rays in the world frame."""
    gray, ranges = _shade(coarse, T_world_camera, environment)
    points = T_world_camera[:3, 3] + np.where(np.isfinite(ranges), ranges, 0)[..., None] * coarse
    image = _upsample(gray * (1 + 0.25 * _random_texture(points, rng)))[: shape[0], : shape[1]]
    return np.ascontiguousarray(image)


def blur_image(image: Gray, blur: float) -> Gray:
    """Convolves the image with a Gaussian point spread of the given standard deviation, pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur)) if blur > 0 else image


@dataclass(frozen=True, eq=False)
class NoisePool:
    """An array of sensor noise larger than the image; every image takes a random part of it.

    Drawing 1.2 million normals for each image would take longer than rendering it; randomly shifted parts are
    independent for any detector of single corners.
    """

    values: NDArray[np.int8]

    def add(self, image: Gray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The image with noise, 8 bits a pixel."""
        height, width = image.shape
        row, column = rng.integers(0, np.array(self.values.shape) - (height, width) + 1)
        piece = self.values[row : row + height, column : column + width]
        noisy = cv2.add(image, piece, dtype=cv2.CV_8U)
        return np.asarray(noisy, dtype=np.uint8)


def draw_noise_pool(camera: CameraModel, sigma: float, rng: np.random.Generator) -> NoisePool:
    """Draws noise of the given standard deviation in grey values."""
    shape = (camera.height + 256, camera.width + 256)
    noise = sigma * rng.standard_normal(shape, dtype=np.float32)
    return NoisePool(np.clip(noise.round(), -127, 127).astype(np.int8))


def draw_board(image: Gray, context: RenderContext, T_world_board: Array, board: PrintedBoard) -> None:
    """Draws the board over the image, in place."""
    T_board_camera = se3.inverse(T_world_board) @ context.T_world_camera
    x, y = _intersect_board(context.rays[:, ::_COARSE_STEP, ::_COARSE_STEP], T_board_camera)
    window = _hit_window((np.abs(x) <= board.size[0] / 2) & (np.abs(y) <= board.size[1] / 2))
    if window is None:
        return
    part = image[window]
    x, y = _intersect_board(context.rays[:, window[0], window[1]], T_board_camera)
    coverage = _pixel_coverage(x, board.size[0]) * _pixel_coverage(y, board.size[1])
    in_front = T_board_camera[2, 3] > 0
    light = _illumination(T_world_board[:3, 2] if in_front else -T_world_board[:3, 2])
    face = (
        _INK_GRAY + (_PAPER_GRAY - _INK_GRAY) * _sample_texture(board, x, y)
        if in_front
        else np.float32(_BACK_GRAY)
    )
    part += coverage * (np.float32(light) * face - part)


def _hit_window(hit: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    """The rows and columns of pixels around the hits (rows, columns) on the coarse grid; None without any."""
    if not hit.any():
        return None
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(hit.any(axis=axis))
        # Two more steps on each side, because an outermost corner may lie between grid points.
        spans.append(slice(_COARSE_STEP * max(int(where[0]) - 2, 0), _COARSE_STEP * (int(where[-1]) + 3)))
    return spans[0], spans[1]


def _intersect_board(rays: Gray, T_board_camera: Array) -> tuple[Gray, Gray]:
    """Intersections of rays (3, rows, columns) in the camera frame with the board's plane: x and y, m, clipped."""
    t = T_board_camera[:3, 3].astype(np.float32)
    d = np.tensordot(T_board_camera[:3, :3].astype(np.float32), rays, axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = -t[2] / d[2]
        # Also false for rays that are NaN.
        valid = (s > 0) & (s < _MAX_DISTANCE)
    s = np.where(valid, s, np.float32(0))
    x, y = t[0] + s * d[0], t[1] + s * d[1]
    return np.where(valid, x, np.float32(_MAX_DISTANCE)), np.where(valid, y, np.float32(_MAX_DISTANCE))


def _pixel_coverage(position: Gray, length: float) -> Gray:
    """The fraction of each pixel's width that lies on the board, along one of the board's axes."""
    pixel = np.abs(np.gradient(position, axis=0)) + np.abs(np.gradient(position, axis=1))
    inside = length / 2 - np.abs(position)
    return np.asarray(np.clip(inside / np.maximum(pixel, 1e-9) + 0.5, 0, 1), dtype=np.float32)


def _sample_texture(board: PrintedBoard, x: Gray, y: Gray) -> Gray:
    """Reflectance 0 to 1 at positions on the board (rows, columns), averaged over the area of each pixel."""
    width, height = board.size
    pixel = float(np.median(np.abs(np.diff(x, axis=1)) + np.abs(np.diff(y, axis=1))))
    texels = board.levels[0].shape[1] / width * pixel / _SUBPIXELS
    texture = board.levels[int(np.clip(np.log2(max(texels, 1.0)), 0, len(board.levels) - 1))]
    u = (x / width + 0.5) * texture.shape[1] - 0.5
    v = (0.5 - y / height) * texture.shape[0] - 0.5
    shape = (_SUBPIXELS * x.shape[1], _SUBPIXELS * x.shape[0])
    u, v = (cv2.resize(m.astype(np.float32), shape, interpolation=cv2.INTER_LINEAR) for m in (u, v))
    samples = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    means = cv2.resize(samples, (x.shape[1], x.shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(means * np.float32(1 / 255), dtype=np.float32)


def draw_solids(image: Gray, context: RenderContext, solids: Sequence[Visible]) -> None:
    """Draws solids over the image, in place, at the coarse resolution."""
    gray, ranges = _shade(context.coarse_rays, context.T_world_camera, solids)
    hit = np.isfinite(ranges)
    window = _hit_window(hit)
    if window is None:
        return
    part = image[window]
    coarse = tuple(slice(span.start // _COARSE_STEP, span.stop // _COARSE_STEP) for span in window)
    mask = _upsample(hit[coarse].astype(np.float64))[: part.shape[0], : part.shape[1]]
    # Outside the mask the grey value is 0, so interpolated values are products already.
    part += _upsample(gray[coarse])[: part.shape[0], : part.shape[1]] - mask * part


def _shade(directions: Array, T_world_camera: Array, solids: Sequence[Visible]) -> tuple[Array, Array]:
    """Grey values of the solids that rays (rows, columns, 3) in the world frame hit, 0 for none; their ranges."""
    hits = cast_rays(solids, T_world_camera[None, :3, 3], directions.reshape(-1, 3))
    brightness = np.array([*(solid.brightness for solid in solids), 0.0])
    gray = brightness[hits.solid] / (1 + 0.08 * np.where(np.isfinite(hits.ranges), hits.ranges, 0))
    return gray.reshape(directions.shape[:2]), hits.ranges.reshape(directions.shape[:2])


def _random_texture(points: Array, rng: np.random.Generator) -> Array:
    """A smooth random pattern of about unit amplitude at points (rows, columns, 3)."""
    waves = rng.standard_normal((3, 12)) * np.geomspace(1, 10, 12)
    return np.asarray(np.sin(points @ waves + rng.uniform(0, 2 * np.pi, 12)).sum(axis=-1) / np.sqrt(12))


def _illumination(normal: Array) -> float:
    """Relative illumination of a surface: lamps under the ceiling and diffuse light."""
    return float(0.62 + 0.38 * max(normal[2], 0) + 0.2 * (1 - abs(normal[2])))


def _upsample(coarse: Array) -> Gray:
    """An image on the coarse grid at full size, up to three rows and columns larger than needed."""
    shape = (_COARSE_STEP * coarse.shape[1], _COARSE_STEP * coarse.shape[0])
    return np.asarray(cv2.resize(coarse.astype(np.float32), shape, interpolation=cv2.INTER_CUBIC))


def render_board_texture(board: Board, texels_per_meter: float) -> Array:
    """Renders the face of a board, upright for a reader: reflectance 0 (ink) to 1 (paper).

    Args:
        board: its print.
        texels_per_meter: resolution; the board's edges fall on texel edges to the nearest whole texel.

    Returns:
        (rows, columns); texel (row, column) is centred at ``x = (column + 0.5) / columns * width - width / 2``
        and ``y = height / 2 - (row + 0.5) / rows * height`` in the board frame.
    """
    width, height = board.size
    columns, rows = (max(1, round(length * texels_per_meter)) for length in (width, height))
    face = np.ones((rows, columns))
    for one in printed_bitmaps(board):
        _draw_print(face, board.size, one)
    return 1 - face if board.inverted else face


def _draw_print(face: Array, size: tuple[float, float], print_: PrintedBitmap) -> None:
    """Draws a bitmap on the face, in place: area weights are separable, so each axis is one small matrix."""
    (rows, columns), (x, y), (width, height) = print_.bitmap.shape, print_.center, print_.size
    across = _overlap_weights(face.shape[1], size[0], columns, x - width / 2, width)
    down = _overlap_weights(face.shape[0], size[1], rows, -y - height / 2, height)
    face *= 1 - np.outer(down.sum(axis=1), across.sum(axis=1))
    face += down @ print_.bitmap @ across.T


def _overlap_weights(texels: int, length: float, modules: int, start: float, extent: float) -> Array:
    """(texels, modules): the fraction of each texel that each module covers, along one axis."""
    texel_edges = np.linspace(-length / 2, length / 2, texels + 1)
    module_edges = start + np.linspace(0, extent, modules + 1)
    low = np.maximum(texel_edges[:-1, None], module_edges[None, :-1])
    high = np.minimum(texel_edges[1:, None], module_edges[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / (length / texels))


# Relative step between the depths of neighbouring pixels that is an edge of an object.
_EDGE_STEP = 0.05
# Probability that a pixel at an edge gets a depth between both: a flying pixel.
_FLYING = 0.3
# Waves of the constant error over half of the image, rad, and their share of what it has at the border: no
# polynomial of low order describes them.
_WAVES, _WAVE_SHARE = 3.0, 0.3
# Depth of pixels that see nothing, m: farther than any camera measures.
_NOTHING = 1e3


def simulate_depth_image(
    sensor: MountedDepthCamera, solids: Sequence[Visible], stamp: float, rng: np.random.Generator
) -> Image:
    """The depth image of a scene that stands still, in whole millimetres.

    Errors are those of a disparity, and so grow with the square of the depth: noise that neighbouring pixels
    share, and a constant part that varies over the image. Windows that contain an edge measure what is nearer.
    """
    options, shape = sensor.options, (sensor.camera.height, sensor.camera.width)
    window = np.ones((options.window, options.window), np.uint8)
    true = _cast_depths(sensor, solids).reshape(shape)
    near, far = cv2.erode(true, window), cv2.dilate(true, window)
    edge = far - near > _EDGE_STEP * near
    flying = edge & (rng.random(shape) < _FLYING)
    near = np.where(edge, near, true)
    depth = np.where(flying, near + rng.random(shape) * (far - near), near)
    # The mean over a window is of variance 1 / window².
    noise = cv2.blur(rng.standard_normal(shape), window.shape, borderType=cv2.BORDER_REFLECT) * options.window
    depth = depth + depth**2 * (options.noise * noise + _warp(sensor, shape))
    measured = (depth >= options.min_range) & (depth <= options.max_range)
    millimetres = np.round(1e3 * np.where(measured, depth, 0.0))
    values = np.where(measured, 1e-3 * millimetres, np.nan).astype(np.float32)
    picture = np.clip(0.255 * millimetres / options.max_range, 0, 255).astype(np.uint8)
    return Image(stamp, sensor.frame_id, picture, values)


def _cast_depths(sensor: MountedDepthCamera, solids: Sequence[Visible]) -> Array:
    """(N,) true depths of all pixels, row by row, m."""
    camera = sensor.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.nan_to_num(camera.rays(np.column_stack([u.ravel(), v.ravel()])), nan=0.0)
    found = np.any(rays, axis=1)
    R, origin = sensor.T_world_sensor[:3, :3], sensor.T_world_sensor[None, :3, 3]
    depths = np.full(len(rays), _NOTHING)
    depths[found] = cast_rays(solids, origin, rays[found] @ R.T).ranges * rays[found, 2]
    return np.asarray(np.minimum(depths, _NOTHING))


def _warp(sensor: MountedDepthCamera, shape: tuple[int, int]) -> Array:
    """(H, W) constant error of depths, m at 1 m."""
    x, y = np.linspace(-1, 1, shape[1]), np.linspace(-1, 1, shape[0])[:, None] * shape[0] / shape[1]
    whole, border = sensor.warp
    waves = np.sin(_WAVES * x + 1e3 * whole) * np.cos(_WAVES * y)
    return np.asarray(whole + border * (x**2 + y**2) + _WAVE_SHARE * border * waves)

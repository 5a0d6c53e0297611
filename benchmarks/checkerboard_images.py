"""Renders images of checkerboards, with the pixels of their corners, independently of calgraph's simulation.

The colour of a pixel is the mean over rays within it that meet a plane; lenses are a radius over the angle from
the axis. Blur, shading, glare, noise and JPEG follow in the image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Layer = NDArray[np.float32]

BOARDS: Final = (
    (5, 4), (7, 5), (8, 6), (9, 6), (11, 8), (12, 9), (14, 10), (18, 12), (20, 14), (24, 16), (26, 15), (28, 17),
)  # fmt: skip
"""Inner corners in a row and in a column."""
SIZES: Final = (
    (640, 480), (752, 480), (1024, 768), (1280, 720), (1280, 960), (1920, 1208), (2048, 1536), (2592, 1944),
    (3264, 2448), (4000, 3000),
)  # fmt: skip
"""Width and height of the images, px: 0.3 to 12 Mpx."""
KINDS: Final = (
    "clean", "defocus", "motion", "glare", "shading", "shadow", "low contrast", "noise", "jpeg", "tilt", "fisheye",
    "narrow margin", "clutter", "far", "filling", "dark room", "overexposed",
)  # fmt: skip
"""What is worst in an image of a board; milder ones of the others come by chance."""
EMPTY_KINDS: Final = ("no board", "other board", "board cut off")
_MIN_GAP = 6.0
"""Shortest distance between neighbouring corners, px: below, no search finds boards reliably."""
_STRIDE = 8
"""Pixels between the rays that are computed; those between are interpolated, with errors below 0.04 px."""


@dataclass(frozen=True, eq=False)
class BoardImage:
    """An image, its kind, its board's inner corners, and their pixels (rows, columns, 2) if all are in it."""

    gray: Gray
    kind: str
    shape: tuple[int, int]
    corners: Array | None


@dataclass(frozen=True, eq=False)
class _Lens:
    """Pixels at a radius of ``focal`` (t + k t^3 + ...) from the centre, t being the angle or its tangent."""

    size: tuple[int, int]
    focal: float
    center: Array
    terms: tuple[float, float]
    fisheye: bool

    def project(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 3)."""
        flat = np.linalg.norm(points[:, :2], axis=1)
        t = np.arctan2(flat, points[:, 2]) if self.fisheye else flat / points[:, 2]
        radius = self.focal * t * (1 + self.terms[0] * t**2 + self.terms[1] * t**4)
        return np.asarray(self.center + points[:, :2] * (radius / np.maximum(flat, 1e-12))[:, None])

    def compute_rays(self, pixels: Array) -> Array:
        """Rays (N, 3) of pixels (N, 2)."""
        offsets = (pixels - self.center) / self.focal
        radius = np.linalg.norm(offsets, axis=1)
        t = np.linspace(0, 1.5 if self.fisheye else 2.5, 4000)
        table = t * (1 + self.terms[0] * t**2 + self.terms[1] * t**4)
        # Beyond the largest radius the lens has no ray; these pixels are outside the board.
        last = int(np.argmax(np.diff(table, append=-np.inf) <= 0))
        angle = np.interp(radius, table[: last + 1], t[: last + 1])
        angle = angle if self.fisheye else np.arctan(angle)
        return np.column_stack([
            offsets * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None], np.cos(angle)
        ])  # fmt: skip


def draw_image(seed: int) -> BoardImage:
    """A board that is wholly in the image; of consecutive seeds, all kinds and boards are drawn equally often."""
    rng = np.random.default_rng((seed, 1))
    kind, shape = KINDS[seed % len(KINDS)], BOARDS[seed // len(KINDS) % len(BOARDS)]
    # Large boards are rarely photographed by small cameras.
    rarely_small = kind == "far" or rng.random() < 0.6
    size = SIZES[int(rng.integers(5 if shape[0] >= 18 and rarely_small else 0, len(SIZES)))]
    for _ in range(2000):
        lens = _draw_lens(rng, size, kind == "fisheye" or rng.random() < 0.2)
        pose = _draw_pose(rng, lens, shape, kind)
        margin = rng.uniform(0.1, 0.3) if kind == "narrow margin" else rng.uniform(0.4, 1.5)
        corners = _project_corners(lens, pose, shape)
        if (
            corners is not None
            and _is_inside(lens, pose, shape, margin)
            and measure_shortest_gap(corners) >= _MIN_GAP
        ):
            break
    else:
        raise RuntimeError(f"seed {seed}: no pose has a board of {shape} in an image of {size}")
    return BoardImage(_photograph(rng, lens, kind, [(pose, shape, margin)], corners), kind, shape, corners)


def draw_empty_image(seed: int) -> BoardImage:
    """An image without a whole board of its shape: of no board, of a board of another shape, or of one cut off."""
    rng = np.random.default_rng((seed, 2))
    kind, shape = EMPTY_KINDS[seed % len(EMPTY_KINDS)], BOARDS[seed // len(EMPTY_KINDS) % len(BOARDS)]
    size = SIZES[int(rng.integers(len(SIZES)))]
    lens = _draw_lens(rng, size, rng.random() < 0.2)
    boards = []
    if kind != "no board":
        drawn = (shape[0] + 2, shape[1] - 1) if kind == "other board" else shape
        for _ in range(2000):
            pose = _draw_pose(rng, lens, drawn, kind)
            corners = _project_corners(lens, pose, drawn)
            if corners is not None and measure_shortest_gap(corners) >= _MIN_GAP:
                inside = ((corners > 0) & (corners < np.array(size) - 1)).all(axis=2).mean()
                if inside == 1 if kind == "other board" else 0.4 < inside < 0.95:
                    boards = [(pose, drawn, rng.uniform(0.4, 1.5))]
                    break
    return BoardImage(_photograph(rng, lens, str(rng.choice(KINDS)), boards, None), kind, shape, None)


def _draw_lens(rng: np.random.Generator, size: tuple[int, int], fisheye: bool) -> _Lens:
    center = (np.array(size) - 1) / 2 + rng.normal(0, 0.01, 2) * size
    if fisheye:
        terms = rng.uniform(-0.06, 0.03), rng.uniform(-0.01, 0.005)
        return _Lens(size, size[0] * rng.uniform(0.35, 0.6), center, terms, True)
    return _Lens(size, size[0] * rng.uniform(0.6, 1.3), center, (rng.uniform(-0.15, 0.08), 0.0), False)


def _draw_pose(rng: np.random.Generator, lens: _Lens, shape: tuple[int, int], kind: str) -> Array:
    """(3, 3) from homogeneous coordinates on the print, in squares from its top left, to the camera."""
    tilt = np.radians(rng.uniform(45, 64) if kind == "tilt" else rng.uniform(0, 45))
    axis = rng.uniform(0, 2 * np.pi)
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.2 else rng.normal(0, 0.3)
    turn, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0]))
    R = np.asarray(turn, dtype=np.float64) @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
    # The board takes a sixth to nearly all of the height of the image, where it faces the camera.
    shares = {"far": (0.17, 0.35), "filling": (0.8, 1.0)}
    share = rng.uniform(*shares.get(kind, (0.17, 0.95)))
    distance = (shape[1] + 1) * lens.focal / (share * lens.size[1])
    spread = 0.5 * (1 - share)
    pixel = lens.center + rng.uniform(-spread, spread, 2) * lens.size
    ray = lens.compute_rays(pixel[None])[0]
    facing = _turn_towards(ray) if lens.fisheye else np.eye(3)
    R = facing @ R
    center = distance * ray - R @ [(shape[0] + 1) / 2, (shape[1] + 1) / 2, 0]
    return np.column_stack([R[:, 0], R[:, 1], center])


def _turn_towards(ray: Array) -> Array:
    """The rotation that turns the axis of the camera into a ray (3)."""
    axis = np.cross([0, 0, 1.0], ray)
    length = float(np.linalg.norm(axis))
    vector = axis * (np.arctan2(length, ray[2]) / max(length, 1e-12))
    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)


def _project_corners(lens: _Lens, pose: Array, shape: tuple[int, int]) -> Array | None:
    """Pixels (rows, columns, 2) of the inner corners, none if a ray does not meet the plane's front."""
    columns, rows = np.meshgrid(np.arange(1.0, shape[0] + 1), np.arange(1.0, shape[1] + 1))
    points = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3) @ pose.T
    # Rays meet the front of the plane: at 7 degrees from its edge at least.
    if (points[:, 2] <= 0.1).any() or (_sines(points, pose) < 0.12).any():
        return None
    return lens.project(points).reshape(shape[1], shape[0], 2)


def _sines(points: Array, pose: Array) -> Array:
    """Sines of the angles between the plane and the rays to points (N, 3) on it, positive at its front."""
    normal = np.cross(pose[:, 0], pose[:, 1])
    return np.asarray(points @ normal / np.linalg.norm(points, axis=1))


def _is_inside(lens: _Lens, pose: Array, shape: tuple[int, int], margin: float) -> bool:
    """Whether the print, with its margin in squares, is in the image."""
    along = np.linspace(0, 1, 12)
    edge = np.concatenate([
        np.stack([along, 0 * along], 1), np.stack([along, 0 * along + 1], 1),
        np.stack([0 * along, along], 1), np.stack([0 * along + 1, along], 1),
    ])  # fmt: skip
    print_size = np.array(shape) + 1.0
    places = edge * (print_size + 2 * margin) - margin
    points = np.column_stack([places, np.ones(len(places))]) @ pose.T
    if (points[:, 2] <= 0.1).any() or (_sines(points, pose) < 0.1).any():
        return False
    pixels = lens.project(points)
    return bool(((pixels > 2) & (pixels < np.array(lens.size) - 3)).all())


def measure_shortest_gap(corners: Array) -> float:
    """Shortest distance between neighbours of corners (rows, columns, 2), px."""
    return float(min(np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min() for axis in (0, 1)))


def _photograph(
    rng: np.random.Generator,
    lens: _Lens,
    kind: str,
    boards: Sequence[tuple[Array, tuple[int, int], float]],
    corners: Array | None,
) -> Gray:
    """The image of boards (pose, shape, margin in squares) in front of a background."""
    gap = 20.0 if corners is None else measure_shortest_gap(corners)
    image = _draw_background(rng, lens.size, 60 if kind == "clutter" else int(rng.integers(3, 25)))
    if kind == "dark room":
        # As that of a board on a screen.
        image *= np.float32(rng.uniform(0.02, 0.2))
    for pose, shape, margin in boards:
        _draw_board(rng, image, lens, pose, shape, margin)
    image *= _draw_illumination(rng, lens.size, kind)
    if kind == "glare":
        _add_glare(rng, image, corners)
    image = _blur(rng, image, kind, gap)
    if kind == "low contrast":
        image = np.float32(rng.uniform(0.2, 0.5)) + np.float32(rng.uniform(0.08, 0.2)) * image
    gain = rng.uniform(1.3, 1.9) if kind == "overexposed" else rng.uniform(0.75, 1.1)
    sigma = rng.uniform(0.03, 0.07) if kind == "noise" else rng.uniform(0.003, 0.015)
    noise = rng.standard_normal(image.shape, dtype=np.float32) * np.float32(sigma)
    values = np.clip(255 * (gain * image + noise), 0, 255).astype(np.uint8)
    quality = rng.integers(15, 40) if kind == "jpeg" else rng.integers(70, 97)
    _, coded = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _draw_background(rng: np.random.Generator, size: tuple[int, int], objects: int) -> Layer:
    """Reflectances (height, width) of a room: a textured wall, furniture, blinds, a tiled floor, a person."""
    width, height = size
    # Objects have sizes of the image, so that those of large images are not finer.
    texture = cv2.resize(
        rng.normal(0, 0.05, (height // 60 + 2, width // 60 + 2)), size, interpolation=cv2.INTER_CUBIC
    )
    image: Layer = np.asarray(rng.uniform(0.2, 0.7) + texture, dtype=np.float32)
    unit = width / 100
    if rng.random() < 0.3:
        _draw_tiles(rng, image, unit)
    for _ in range(objects):
        center, extent = rng.uniform(0, 1, 2) * size, rng.uniform(1, 14, 2) * unit
        box = cv2.boxPoints((center.tolist(), extent.tolist(), float(rng.choice([0, 90, rng.uniform(0, 180)]))))
        cv2.fillPoly(image, [np.rint(box).astype(np.int32)], rng.uniform(0.05, 0.95))
    for _ in range(objects // 10):
        # Blinds, shelves, and keyboards.
        corner, pitch = rng.uniform(0, 0.8, 2) * size, rng.uniform(0.8, 2.5) * unit
        for i in range(int(rng.integers(4, 15))):
            for j in range(int(rng.choice([1, 1, 8]))):
                a = corner + np.array([j * pitch, i * pitch])
                b = a + np.array([pitch * rng.uniform(0.4, 0.7), pitch * 0.6])
                cv2.rectangle(image, _round(a), _round(b), rng.uniform(0.05, 0.9), -1)
    if rng.random() < 0.6:
        _draw_person(rng, image, unit)
    return np.asarray(np.clip(image, 0.02, 1), dtype=np.float32)


def _draw_tiles(rng: np.random.Generator, image: Layer, unit: float) -> None:
    """A floor of two colours in the lower part of the image."""
    height, width = image.shape
    pitch, colours = rng.uniform(3, 8) * unit, rng.uniform(0.1, 0.8, 2)
    tiles = np.indices((16, 24)).sum(axis=0) % 2
    sheet = np.where(tiles, colours[0], colours[1]).repeat(16, axis=0).repeat(16, axis=1).astype(np.float32)
    top, spread = height * rng.uniform(0.6, 0.8), rng.uniform(1.5, 3)
    ends = np.array([
        [width / 2 - 12 * pitch, top], [width / 2 + 12 * pitch, top],
        [width / 2 + 12 * spread * pitch, height * 1.6], [width / 2 - 12 * spread * pitch, height * 1.6],
    ])  # fmt: skip
    edges = np.array([[0, 0], [384, 0], [384, 256], [0, 256]])
    H = cv2.getPerspectiveTransform(edges.astype(np.float32), ends.astype(np.float32))
    cv2.warpPerspective(sheet, H, (width, height), image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)


def _draw_person(rng: np.random.Generator, image: Layer, unit: float) -> None:
    """A person next to the board: head, trunk with a striped shirt, and legs."""
    x, y = rng.uniform(0.1, 0.9) * image.shape[1], rng.uniform(0.1, 0.4) * image.shape[0]
    size, shirt, stripe = rng.uniform(3, 8) * unit, *rng.uniform(0.05, 0.9, 2)
    cv2.ellipse(image, (_round([x, y]), _round([size, 1.3 * size]), 0.0), rng.uniform(0.3, 0.7), -1)
    cv2.rectangle(image, _round([x - 1.6 * size, y + size]), _round([x + 1.6 * size, y + 6 * size]), shirt, -1)
    for i in range(6):
        low = y + size * (1.2 + 0.8 * i)
        cv2.rectangle(image, _round([x - 1.6 * size, low]), _round([x + 1.6 * size, low + 0.3 * size]), stripe, -1)
    for side in (-1, 0.1):
        left = x + side * size
        cv2.rectangle(image, _round([left, y + 6 * size]), _round([left + size, y + 14 * size]), 0.15, -1)


def _round(pixel: Sequence[float] | Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))


def _draw_board(
    rng: np.random.Generator, image: Layer, lens: _Lens, pose: Array, shape: tuple[int, int], margin: float
) -> None:
    """Draws a board into the image: the print, its white margin, a larger board under it, and hands."""
    columns, rows = shape[0] + 1, shape[1] + 1
    behind = rng.uniform(0.05, 1.5) if rng.random() < 0.6 else 0.0
    ink, paper, wood = rng.uniform(0.03, 0.12), rng.uniform(0.75, 0.95), rng.uniform(0.1, 0.9)
    outer = margin + behind
    # Hands hold the board at its left and right edges, and end in the margin.
    hands = [
        (np.array([side, rng.uniform(0.2, 0.8) * rows]), np.array([outer - 0.2 * margin, rng.uniform(0.5, 1.0)]))
        for side in (-outer, columns + outer)
        if rng.random() < 0.4
    ]
    skin = rng.uniform(0.3, 0.6)

    def reflect(x: Layer, y: Layer) -> tuple[Layer, NDArray[np.bool_]]:
        """Reflectances at places, in squares from the top left of the print, and which are on the board."""
        on_board = (x > -outer) & (x < columns + outer) & (y > -outer) & (y < rows + outer)
        on_sheet = (x > -margin) & (x < columns + margin) & (y > -margin) & (y < rows + margin)
        printed = (x > 0) & (x < columns) & (y > 0) & (y < rows)
        dark = printed & ((np.floor(x) + np.floor(y)) % 2 == 0)
        values = np.where(dark, ink, np.where(on_sheet, paper, wood)).astype(np.float32)
        for center, extent in hands:
            held = ((x - center[0]) / extent[0]) ** 2 + ((y - center[1]) / extent[1]) ** 2 < 1
            values[held], on_board = skin, on_board | held
        return values, on_board

    low, high = _bound_board(lens, pose, (columns, rows), outer + 1)
    if (high > low).all():
        # Squares of few pixels need more samples, and are in small parts of images.
        fine = 4 if np.prod(high - low) < 1.5e6 else 2
        _trace(image, lens, pose, low, high, fine, reflect)


def _bound_board(
    lens: _Lens, pose: Array, size: tuple[int, int], outer: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """First and last pixel (x, y) of the part of the image that contains the board, in steps of ``_STRIDE``."""
    along = np.linspace(0, 1, 25)
    grid = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    places = grid * (np.array(size) + 2 * outer) - outer
    points = np.column_stack([places, np.ones(len(places))]) @ pose.T
    pixels = lens.project(points[points[:, 2] > 0.1])
    low = np.clip(np.floor(pixels.min(axis=0) / _STRIDE), 0, None).astype(int) * _STRIDE
    high = np.minimum(np.ceil(pixels.max(axis=0) / _STRIDE).astype(int) * _STRIDE, lens.size)
    return low, high


def _trace(
    image: Layer,
    lens: _Lens,
    pose: Array,
    low: NDArray[Any],
    high: NDArray[Any],
    fine: int,
    reflect: Callable[[Layer, Layer], tuple[Layer, NDArray[np.bool_]]],
) -> None:
    """Replaces the pixels low to high of an image by the means over ``fine`` by ``fine`` rays in each."""
    width, height = (high - low).tolist()
    # One cell more on each side: interpolation at the border needs it.
    u = low[0] + _STRIDE * (np.arange(-1, -(-width // _STRIDE) + 1) + 0.5) - 0.5
    v = low[1] + _STRIDE * (np.arange(-1, -(-height // _STRIDE) + 1) + 0.5) - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    coarse = (lens.compute_rays(pixels) @ np.linalg.inv(pose).T).reshape(len(v), len(u), 3).astype(np.float32)
    for top in range(0, len(v) - 2, 16):
        # Strips of 128 rows bound the memory.
        part = coarse[top : top + 18]
        zoom = _STRIDE * fine
        rays = cv2.resize(part, (part.shape[1] * zoom, part.shape[0] * zoom), interpolation=cv2.INTER_LINEAR)
        rays = rays[zoom:-zoom, zoom:-zoom]
        ahead = rays[..., 2] > 1e-6
        depth = np.where(ahead, rays[..., 2], 1)
        values, on_board = reflect(
            np.where(ahead, rays[..., 0] / depth, -99), np.where(ahead, rays[..., 1] / depth, -99)
        )
        shape = (rays.shape[1] // fine, rays.shape[0] // fine)
        cover = cv2.resize(on_board.astype(np.float32), shape, interpolation=cv2.INTER_AREA)
        values = np.asarray(cv2.resize(values * on_board, shape, interpolation=cv2.INTER_AREA), dtype=np.float32)
        first = low[1] + top * _STRIDE
        target = image[first : min(first + shape[1], high[1]), low[0] : high[0]]
        rows, columns = target.shape
        target[:] = (1 - cover[:rows, :columns]) * target + values[:rows, :columns]


def _draw_illumination(rng: np.random.Generator, size: tuple[int, int], kind: str) -> Layer:
    """Light (height, width) on the scene, at most 1."""
    width, height = size
    x, y = np.meshgrid(np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32))
    angle = rng.uniform(0, 2 * np.pi)
    along = np.float32(np.cos(angle)) * x + np.float32(np.sin(angle)) * y
    # Shading: light falls to a twelfth across the image.
    fall = rng.uniform(1.2, 2.5) if kind == "shading" else rng.uniform(0, 0.5)
    light = np.exp(np.float32(-0.5 * fall) * (along + 1.4)) * (1 - np.float32(rng.uniform(0, 0.2)) * (x**2 + y**2))
    if kind == "shadow":
        for _ in range(int(rng.integers(1, 4))):
            angle, place, soft = rng.uniform(0, np.pi), rng.uniform(-0.4, 0.4), rng.uniform(0.005, 0.1)
            side = (np.float32(np.cos(angle)) * x + np.float32(np.sin(angle)) * y - place) / np.float32(soft)
            light *= 1 - np.float32(rng.uniform(0.4, 0.8)) / (1 + np.exp(-np.clip(side, -30, 30)))
    return np.asarray(light, dtype=np.float32)


def _add_glare(rng: np.random.Generator, image: Layer, corners: Array | None) -> None:
    """Adds the reflection of a lamp on the board, brighter than the paper in its middle."""
    height, width = image.shape
    middle, extent = np.array([width / 2, height / 2]), width / 4
    if corners is not None:
        middle = corners.reshape(-1, 2)[rng.integers(corners.size // 2)]
        extent = float(np.ptp(corners, axis=(0, 1)).mean())
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    sigma = extent * rng.uniform(0.08, 0.35, 2)
    power = ((x - middle[0]) / np.float32(sigma[0])) ** 2 + ((y - middle[1]) / np.float32(sigma[1])) ** 2
    image += np.float32(rng.uniform(0.3, 1.1)) * np.exp(-0.5 * power)


def _blur(rng: np.random.Generator, image: Layer, kind: str, gap: float) -> Layer:
    """Blurs an image by its lens, its focus and its motion; squares remain visible at a gap of corners, px."""
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 0.9)), dtype=np.float32)
    if kind == "defocus":
        reach = min(0.3 * gap, rng.uniform(1.5, 9))
        offsets = np.arange(-int(reach) - 1, int(reach) + 2)
        kernel = np.clip(reach + 0.5 - np.hypot(*np.meshgrid(offsets, offsets)), 0, 1)
        image = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.float32)
    if kind == "motion":
        reach = min(0.3 * gap, rng.uniform(1.5, 9))
        side = 2 * int(reach + 1) + 1
        kernel = np.zeros((side, side), dtype=np.float32)
        angle = rng.uniform(0, np.pi)
        for place in np.linspace(-reach, reach, 200):
            # Shares of a pixel fall to its neighbours.
            column, row = side // 2 + place * np.array([np.cos(angle), np.sin(angle)])
            i, j, fi, fj = int(row), int(column), row % 1, column % 1
            kernel[i : i + 2, j : j + 2] += np.outer([1 - fi, fi], [1 - fj, fj])[: side - i, : side - j]
        image = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.float32)
    return image

"""Messages of random rigs: images, scans and clouds of a world with the errors of random_rig_draws.py."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.config import Board, CameraSpec
from calgraph.geometry import Array, se3, so3
from calgraph.recording.record_list import MessageRecording
from calgraph.sensors import CameraInfo, CameraModel, Image, Message, Trigger
from calgraph.simulation.camera_render import render_board_texture
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.scanners import laser_scan, point_cloud, simulate_ranges
from calgraph.simulation.solids import Solid, cast_rays
from ideal_detections import as_scanner
from random_rig_draws import EMPTY_STEP, POSE_STEP, STREAM_EMPTY, TRIGGER, RandomRig, Shown
from rig_errors import BoardErrors

Gray = NDArray[np.float32]
Measure = Callable[[Shown | None, float, float], Message]
"""The message of what is in the room, after a share of the captures, with a stamp."""
_START = 1_700_000_000.0
_SUBPIXELS = 2
_COARSE = 4
"""Step of the grid on which everything but boards is drawn, pixels."""
_HOLD, _MOVE = 1.6, 0.7
"""Durations in recordings without trigger, s."""
_FRAME_STEP, _LEG = 0.25, 1.5
"""Times between synchronized frames, and from pose to pose of a board that never rests, s."""
_TRIGGERED = 2
"""Measurements of each sensor after a trigger."""
_TEXELS = 600.0
"""Of a print, per metre."""


@dataclass(frozen=True)
class FaceShape:
    """The face of a board with its bow, as a solid."""

    board: Board
    errors: BoardErrors

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the face, m."""
        return 0.5 * float(np.hypot(*self.errors.true_size(self.board))) + max(abs(b) for b in self.errors.bow)

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (3, N) in the board's frame, infinite where they miss."""
        with np.errstate(divide="ignore", invalid="ignore"):
            starts = np.broadcast_to(origins, directions.shape)
            t = self.errors.distance(self.board, starts.T, directions.T)
            x, y = (starts[i] + t * directions[i] for i in (0, 1))
            width, height = self.errors.true_size(self.board)
            hit = (t > 0) & (np.abs(x) <= width / 2) & (np.abs(y) <= height / 2)
        return np.where(hit, t, np.inf)


def record(rig: RandomRig) -> MessageRecording:
    """Everything that is recorded of a rig."""
    messages: dict[str, list[Message]] = {}
    for k, sensor in enumerate(rig.robot):
        rng = np.random.default_rng((rig.seed, 1 + k))
        measure = (
            _camera(rig, sensor, rng)
            if isinstance(sensor, MountedCamera)
            else _scanner(rig, as_scanner(sensor), rng)
        )
        topic = rig.stated.topics[sensor.name]
        messages[topic] = [
            measure(shown, done, _START + time + rig.delays[sensor.name])
            for time, shown, done in _times(rig, sensor)
        ]
        spec = rig.stated.sensors[sensor.name]
        if isinstance(spec, CameraSpec) and isinstance(sensor, MountedCamera) and spec.camera_info:
            messages[spec.camera_info] = [CameraInfo(_START, sensor.frame_id, sensor.camera)]
    if rig.mode == "trigger":
        messages[TRIGGER] = [Trigger(_START + _first(rig) + _step(rig) * k) for k in range(len(rig.captures))]
    return MessageRecording(messages)


def _times(rig: RandomRig, sensor: RobotSensor) -> Iterator[tuple[float, Shown | None, float]]:
    """Times of measurements of a sensor, s, what is in the room, and the share of the captures done."""
    period, count = sensor.clock.period, len(rig.captures)
    if rig.mode == "snapshots":
        yield from ((EMPTY_STEP * k, None, 0.0) for k in range(rig.empty))
        for k, shown in enumerate(rig.captures):
            yield _first(rig) + POSE_STEP * k, shown, k / count
        return
    if rig.empty:
        yield from ((time, None, 0.0) for time in np.arange(0.1, STREAM_EMPTY - sensor.clock.duration, period))
    step = _step(rig)
    if rig.mode == "synchronized":
        for time in np.arange(_first(rig), _first(rig) + step * (count - 1), _FRAME_STEP):
            # A clock that is right: what is measured is where the board is at the stamp.
            passed, after = divmod(time + rig.delays[sensor.name] - _first(rig), step)
            k = min(max(int(passed), 0), count - 2)
            yield float(time), _between(rig.captures[k], rig.captures[k + 1], min(after / step, 1.0)), k / count
        return
    if rig.mode == "trigger":
        for k, shown in enumerate(rig.captures):
            start = _first(rig) + step * k + 0.03
            yield from ((start + period * i, shown, k / count) for i in range(_TRIGGERED))
        return
    for time in np.arange(_first(rig) - _MOVE, _first(rig) + step * count - _MOVE, period):
        moved, after = divmod(time - _first(rig) + _MOVE, step)
        k = min(int(moved), count - 1)
        yield (
            float(time),
            _between(rig.captures[max(k - 1, 0)], rig.captures[k], min(after / _MOVE, 1.0)),
            k / count,
        )


def _first(rig: RandomRig) -> float:
    """Start of the first capture, s."""
    if rig.mode == "snapshots":
        return EMPTY_STEP * rig.empty + 1.0
    return (STREAM_EMPTY if rig.empty else 0.0) + _MOVE + 0.3


def _step(rig: RandomRig) -> float:
    """Time from capture to capture in streams, s."""
    if rig.mode == "rest":
        return _MOVE + _HOLD
    if rig.mode == "synchronized":
        return _LEG
    return 0.2 + _MOVE + _TRIGGERED * max(s.clock.period + s.clock.duration for s in rig.robot)


def _between(a: Shown, b: Shown, share: float) -> Shown:
    """The room while boards move from one capture to the next, steadily."""
    if share >= 1 or a.boards.keys() != b.boards.keys():
        return b
    moved = {i: se3.retract(a.boards[i], share * se3.difference(T, a.boards[i])) for i, T in b.boards.items()}
    return Shown(moved, b.people)


def _solids(rig: RandomRig, shown: Shown | None, sensor: str) -> tuple[Solid, ...]:
    if shown is None:
        return rig.environment
    faces = [Solid(FaceShape(rig.boards[i], rig.errors.board), T) for i, T in shown.boards_of(sensor).items()]
    return (*rig.environment, *shown.people, *faces)


def _scanner(rig: RandomRig, sensor: MountedScanner, rng: np.random.Generator) -> Measure:
    errors = rig.errors.of_scanner(sensor.name)
    true = errors.true_pattern(sensor.pattern)
    message = laser_scan if sensor.kind == "lidar2d" else point_cloud

    def measure(shown: Shown | None, done: float, stamp: float) -> Message:
        solids = _solids(rig, shown, sensor.name)
        T = errors.pose(sensor.T_world_sensor, done)
        ranges = simulate_ranges(true, T, 0.0, lambda _a, _b: [(np.inf, solids)], sensor.noise, rng)
        ranges = errors.measured_ranges(ranges, sensor.pattern.rings)
        with np.errstate(invalid="ignore"):
            ranges = np.where(ranges > 0.01, ranges, np.nan)
        return message(sensor.pattern, ranges, stamp, sensor.frame_id)

    return measure


def _camera(rig: RandomRig, sensor: MountedCamera, rng: np.random.Generator) -> Measure:
    errors = rig.errors.of_camera(sensor.name)
    true = errors.true_camera(sensor.camera)
    waves = rng.standard_normal((3, 8)) * np.geomspace(1, 8, 8), rng.uniform(0, 2 * np.pi, 8)
    prints = [_texture(board, rig.errors.board) for board in rig.boards]
    noise = _noise(rng, sensor.camera, rig.gray_noise)

    @lru_cache(maxsize=2)
    def lens(shift: tuple[float, float]) -> tuple[CameraModel, Array, Gray]:
        K = true.K.copy()
        K[:2, 2] += shift
        camera = CameraModel(true.model, true.width, true.height, K, true.distortion)
        return camera, _rays(camera, _COARSE), _fine_rays(camera)

    @lru_cache(maxsize=1)
    def empty(pose: bytes, shift: tuple[float, float]) -> Gray:
        return _shade(np.frombuffer(pose).reshape(4, 4), lens(shift)[1], rig.environment, waves)

    def measure(shown: Shown | None, done: float, stamp: float) -> Message:
        T = errors.pose(sensor.T_world_sensor, done)
        shift = tuple(errors.shift(done).tolist())
        camera, coarse, fine = lens(shift)
        image = empty(T.tobytes(), shift)
        if shown is not None:
            image = _shade(T, coarse, (*rig.environment, *shown.people), waves) if shown.people else image
        image = _enlarge(image, (camera.height, camera.width))
        if shown is not None:
            boards = shown.boards_of(sensor.name).items()
            for i, T_world_board in sorted(boards, key=lambda b: -float(np.linalg.norm(b[1][:3, 3] - T[:3, 3]))):
                _draw_board(image, fine, T, T_world_board, rig.boards[i], rig.errors.board, prints[i])
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rig.blur))
        row, column = rng.integers(0, 64, 2)
        piece = noise[row : row + camera.height, column : column + camera.width]
        pixels = np.asarray(cv2.add(image, piece, dtype=cv2.CV_8U), dtype=np.uint8)
        return Image(stamp, sensor.frame_id, pixels)

    return measure


def _noise(rng: np.random.Generator, camera: CameraModel, sigma: float) -> NDArray[np.int8]:
    noise = sigma * rng.standard_normal((camera.height + 64, camera.width + 64), dtype=np.float32)
    return np.asarray(np.clip(noise.round(), -127, 127), dtype=np.int8)


def _rays(camera: CameraModel, step: int) -> Array:
    """(rows, columns, 3) rays of every ``step``-th pixel; those without a ray point backwards."""
    columns, rows = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    rays = camera.rays(pixels).reshape(*columns.shape, 3)
    return np.where(np.isfinite(rays), rays, [0.0, 0.0, -1.0])


def _fine_rays(camera: CameraModel) -> Gray:
    """(2 rows, 2 columns, 3) rays of subpixels, linear between those of every second pixel: to 0.003 pixels."""
    columns, rows = np.meshgrid(np.arange(0, camera.width + 2, 2), np.arange(0, camera.height + 2, 2))
    rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64))
    grid = np.where(np.isfinite(rays), rays, [0.0, 0.0, -1.0]).reshape(*columns.shape, 3).astype(np.float32)
    for axis, length in enumerate((camera.height, camera.width)):
        at = np.maximum((np.arange(_SUBPIXELS * length) + 0.5) / _SUBPIXELS - 0.5, 0.0) / 2
        first = at.astype(int)
        share = (at - first).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        grid = (1 - share) * grid.take(first, axis) + share * grid.take(first + 1, axis)
    return np.asarray(grid, dtype=np.float32)


def _shade(T_world_camera: Array, rays: Array, solids: tuple[Solid, ...], waves: tuple[Array, Array]) -> Gray:
    """The room at the coarse resolution, with a smooth texture on all surfaces."""
    directions = rays @ T_world_camera[:3, :3].T
    hits = cast_rays(solids, T_world_camera[None, :3, 3], directions.reshape(-1, 3))
    near = np.where(np.isfinite(hits.ranges), hits.ranges, 0.0)
    points = T_world_camera[:3, 3] + near[:, None] * directions.reshape(-1, 3)
    texture = np.sin(points @ waves[0] + waves[1]).sum(axis=-1) / np.sqrt(8)
    brightness = np.array([*(solid.brightness for solid in solids), 0.0])[hits.solid]
    gray = brightness / (1 + 0.08 * near) * (1 + 0.25 * texture)
    return np.asarray(np.clip(gray, 0, 255).reshape(rays.shape[:2]), dtype=np.float32)


def _enlarge(coarse: Gray, shape: tuple[int, int]) -> Gray:
    size = (_COARSE * coarse.shape[1], _COARSE * coarse.shape[0])
    fine = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    return np.array(fine[: shape[0], : shape[1]], dtype=np.float32)


def _texture(board: Board, errors: BoardErrors) -> list[NDArray[np.uint8]]:
    """The print of a board as an image pyramid, with wrong sizes and places of its tags."""
    tags = []
    for tag in board.tags:
        dx, dy = errors.tag_position.get(tag.id, (0.0, 0.0))
        center = tag.center[0] + dx, tag.center[1] + dy
        tags.append(tag.model_copy(update={"size": tag.size * (1 + errors.tag_size), "center": center}))
    face = render_board_texture(board.model_copy(update={"tags": tuple(tags)}), _TEXELS)
    levels = [np.asarray(255 * face, dtype=np.float32)]
    while min(levels[-1].shape) >= 32:
        rows, columns = levels[-1].shape
        smaller = cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, dtype=np.float32))
    return [level.round().astype(np.uint8) for level in levels]


def _draw_board(
    image: Gray,
    rays: Gray,
    T_world_camera: Array,
    T_world_board: Array,
    board: Board,
    errors: BoardErrors,
    texture: list[NDArray[np.uint8]],
) -> None:
    """Draws a board over the image, in place; every pixel is the mean of its subpixels."""
    T_board_camera = se3.inverse(T_world_board) @ T_world_camera
    width, height = errors.true_size(board)
    window = _window(rays[:: 2 * _SUBPIXELS, :: 2 * _SUBPIXELS], T_board_camera, board, errors)
    if window is None:
        return
    rows, columns = window
    part = rays[_fine(rows), _fine(columns)]
    x, y = _intersect(part, T_board_camera, board, errors)
    covered = ((np.abs(x) <= width / 2) & (np.abs(y) <= height / 2)).astype(np.float32)
    front = T_board_camera[2, 3] > 0
    normal = T_world_board[:3, 2] if front else -T_world_board[:3, 2]
    light = 0.62 + 0.38 * max(normal[2], 0) + 0.2 * (1 - abs(normal[2]))
    face = light * (25 + 200 / 255 * _sample(texture, x, y, board, errors)) if front else light * 110 + 0 * x
    size = (columns.stop - columns.start, rows.stop - rows.start)
    shade = cv2.resize((covered * face).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    coverage = cv2.resize(covered, size, interpolation=cv2.INTER_AREA)
    image[rows, columns] += shade - coverage * image[rows, columns]


def _fine(span: slice) -> slice:
    return slice(_SUBPIXELS * span.start, _SUBPIXELS * span.stop)


def _window(rays: Gray, T_board_camera: Array, board: Board, errors: BoardErrors) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels that show the board, from every second pixel; None if none does."""
    x, y = _intersect(rays, T_board_camera, board, BoardErrors())
    width, height = errors.true_size(board)
    hit = (np.abs(x) <= 0.55 * width) & (np.abs(y) <= 0.55 * height)
    if not hit.any():
        return None
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(hit.any(axis=axis))
        length = 2 * hit.shape[1 - axis]
        spans.append(slice(max(2 * int(where[0]) - 4, 0), min(2 * int(where[-1]) + 6, length)))
    return spans[0], spans[1]


def _intersect(rays: Gray, T_board_camera: Array, board: Board, errors: BoardErrors) -> tuple[Gray, Gray]:
    """Where rays (rows, columns, 3) in the camera frame meet the face: x and y in the board's frame, m."""
    d = rays.reshape(-1, 3) @ T_board_camera[:3, :3].T.astype(np.float32)
    o = T_board_camera[:3, 3].astype(np.float32)
    with np.errstate(all="ignore"):
        if any(errors.bow):
            t = errors.distance(board, np.broadcast_to(o, d.shape).astype(np.float64), d.astype(np.float64))
            t = t.astype(np.float32)
        else:
            t = -o[2] / d[:, 2]
        valid = (t > 0) & (t < 1e3)
        t = np.where(valid, t, np.float32(0))
    x, y = (np.where(valid, o[i] + t * d[:, i], np.float32(1e3)).reshape(rays.shape[:2]) for i in (0, 1))
    return x, y


def _sample(texture: list[NDArray[np.uint8]], x: Gray, y: Gray, board: Board, errors: BoardErrors) -> Gray:
    """Reflectance 0 to 255 at places on the board, with the errors of the print as a whole."""
    R = so3.exp(np.array([0.0, 0.0, errors.print_rotation]))[:2, :2]
    stretch = (1 + errors.print_scale) * (1 + 0.5 * errors.print_aspect * np.array([1.0, -1.0]))
    dx, dy = x - errors.print_position[0], y - errors.print_position[1]
    px = (R[0, 0] * dx + R[1, 0] * dy) / stretch[0]
    py = (R[0, 1] * dx + R[1, 1] * dy) / stretch[1]
    inside = (np.abs(x) < 900) & (np.abs(y) < 900)
    steps = np.abs(np.diff(np.where(inside, px, np.nan), axis=1)) + np.abs(
        np.diff(np.where(inside, py, np.nan), axis=1)
    )
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1e-3
    texels = texture[0].shape[1] / board.size[0] * step
    level = texture[int(np.clip(np.log2(max(texels, 1.0)), 0, len(texture) - 1))]
    u = (px / board.size[0] + 0.5) * level.shape[1] - 0.5
    v = (0.5 - py / board.size[1]) * level.shape[0] - 0.5
    sampled = cv2.remap(
        level, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(sampled, dtype=np.float32)

"""Small pictures of the sensors' views, with the detected board drawn in."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, Detection, DetectionResult, PlanePatch, Segment
from calgraph.config import Board
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.live.analysis_jobs import DetectorInputs, UnprojectedBoard, make_detector
from calgraph.report.image_view import sample_outline
from calgraph.sensors import CameraModel, Image, LaserScan, Message, PointCloud

Pixels = NDArray[np.uint8]
# Colours in OpenCV's order, on a dark background: the board is the brightest.
_BACKGROUND, _POINTS, _BOARD, _SENSOR = (24, 18, 15), (215, 195, 170), (90, 255, 120), (60, 160, 255)


@dataclass(frozen=True, eq=False)
class SensorView:
    """The view of one sensor in one message."""

    picture: bytes
    """JPEG; empty if the message is unusable."""
    sees_board: bool | None
    """None if it was not searched."""
    reason: str = ""
    """Why there is no board."""
    sharpness: float = 0.0
    """Variance of the Laplacian of an image; 0 of scanners."""


# Width of a picture, px: that of a phone with two pictures beside each other; and quality of its JPEG of 15 kB:
# lower ones blur outlines.
_WIDTH, _QUALITY = 480, 60
# Minimum width of the images in which the board is searched for a picture, px: larger ones are reduced by a whole
# factor to no less, which takes a quarter of the time.
_DETECTION_WIDTH = 800


def find_reduction(camera: CameraModel) -> int:
    """The whole factor by which images are reduced before the board is searched for a picture."""
    return max(camera.width // _DETECTION_WIDTH, 1)


def make_view(
    decode: Callable[[], Message],
    inputs: DetectorInputs | None,
    camera: CameraModel | None,
    boards: Sequence[Board],
    factor: int,
) -> SensorView:
    """Detects the board in one message and draws both.

    Args:
        decode: decodes the message.
        inputs: of the detector; of cameras for images reduced by ``factor``. None if the board is not searched.
        camera: intrinsics of the reduced images.
        boards: of the rig.
        factor: by which images are reduced.

    Raises:
        CalgraphError: the message is unusable.
    """
    message = decode()
    if isinstance(message, Image):
        message = _reduce(message, factor)
    found = make_detector(inputs)([message]) if inputs else None
    if isinstance(message, Image):
        picture = _draw_image(message, found, camera, boards)
        sharpness = float(cv2.Laplacian(message.gray, cv2.CV_64F).var())
    else:
        picture, sharpness = _draw_from_above(message, found), 0.0
    reason = found.reason if isinstance(found, Rejected) else ""
    sees_board = not reason or isinstance(found, UnprojectedBoard)
    return SensorView(picture, None if found is None else sees_board, reason, sharpness)


def _reduce(image: Image, factor: int) -> Image:
    if factor == 1:
        return image
    height, width = image.pixels.shape[:2]
    size = width // factor, height // factor
    # Whole blocks are averaged: the pixels beyond the last block are left out.
    whole = image.pixels[: size[1] * factor, : size[0] * factor]
    reduced = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return Image(image.stamp, image.frame_id, reduced)


def _list_found(found: DetectionResult | None) -> tuple[Detection, ...]:
    return () if found is None or isinstance(found, Rejected) else found


def _draw_image(
    image: Image, found: DetectionResult | None, camera: CameraModel | None, boards: Sequence[Board]
) -> bytes:
    height, width = image.pixels.shape[:2]
    scale = min(_WIDTH / width, 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    pixels = np.asarray(cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    colored = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels
    canvas = np.ascontiguousarray(colored, dtype=np.uint8)
    for one in _list_found(found):
        if isinstance(one, BoardCorners) and camera:
            corners = (
                np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*boards[one.board].size, 0.0] / 2
            )
            outline = sample_outline(se3.apply(one.T_camera_board, corners))
            _draw_line(canvas, scale * camera.project(outline), closed=True)
            _draw_corners(canvas, scale * one.pixels)
    if isinstance(found, UnprojectedBoard):
        _draw_corners(canvas, scale * np.array(found.pixels))
    return _encode_picture(canvas)


def _draw_corners(canvas: Pixels, pixels: Array) -> None:
    for u, v in pixels:
        cv2.circle(canvas, (round(float(u)), round(float(v))), 2, _BOARD, -1, cv2.LINE_AA)


# Largest distance that pictures of scanners show, m: boards are carried nearer, and are well visible.
_MAX_RANGE = 5.0


def _draw_from_above(message: Message, found: DetectionResult | None) -> bytes:
    """The points of a scanner from above, x up, y to the left."""
    size = _WIDTH
    scale = size / (2 * _MAX_RANGE)
    canvas: Pixels = np.full((size, size, 3), _BACKGROUND, dtype=np.uint8)
    if isinstance(message, LaserScan):
        _draw_points(canvas, message.points[message.valid], scale, _POINTS)
    elif isinstance(message, PointCloud):
        _draw_points(canvas, message.points, scale, _POINTS)
    for one in _list_found(found)[:1]:
        if isinstance(one, PlanePatch):
            _draw_points(canvas, one.points, scale, _BOARD)
        elif isinstance(one, Segment):
            _draw_line(canvas, _project_from_above(one.endpoints, size, scale), closed=False)
    cv2.circle(canvas, (size // 2, size // 2), 4, _SENSOR, -1, cv2.LINE_AA)
    return _encode_picture(canvas)


def _project_from_above(points: Array, size: int, scale: float) -> Array:
    return size / 2 - scale * points[:, [1, 0]]


def _draw_points(canvas: Pixels, points: Array, scale: float, color: tuple[int, int, int]) -> None:
    pixels = _project_from_above(points, len(canvas), scale)
    inside = pixels[((pixels >= 1) & (pixels < len(canvas) - 1)).all(axis=1)].astype(np.intp)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            canvas[inside[:, 1] + dy, inside[:, 0] + dx] = color


def _draw_line(canvas: Pixels, pixels: Array, *, closed: bool) -> None:
    # Projections of points beside or behind a camera are anywhere.
    limited = np.clip(np.nan_to_num(pixels), -1e4, 1e4).round().astype(np.int32)
    cv2.polylines(canvas, [limited], closed, _BOARD, 4, cv2.LINE_AA)


def _encode_picture(canvas: Pixels) -> bytes:
    return cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()

"""Thumbnails of each sensor's measurement in every capture, and the reason of each rejection."""

import struct
import zlib
from base64 import b64encode

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.report.templates import render
from calgraph.result import Calibration, CaptureRow, Snapshot

# Largest number of thumbnails on the page.
_MAX_IMAGES = 1000


def render_gallery(calibration: Calibration) -> Markup:
    """A card for each capture with snapshots; empty where there are none."""
    taken = {(s.capture, s.sensor): s for s in calibration.pictures.snapshots}
    rows: dict[int, list[CaptureRow]] = {}
    for row in calibration.evidence.captures:
        rows.setdefault(row.capture, []).append(row)
    pictured = [capture for capture in rows if any((capture, row.sensor) in taken for row in rows[capture])]
    if not pictured:
        return Markup()
    each = max(len(rows[capture]) for capture in pictured)
    shown = pictured[:: len(pictured) * each // _MAX_IMAGES + 1]
    boards = {(view.capture, view.sensor): view.measured for view in calibration.pictures.board_views}
    cards = [
        {
            "capture": capture,
            "rows": rows[capture],
            "urls": {
                row.sensor: render_thumbnail(
                    taken[capture, row.sensor], boards.get((capture, row.sensor), np.empty((0, 3)))
                )
                for row in rows[capture]
                if (capture, row.sensor) in taken
            },
        }
        for capture in shown
    ]
    return render("gallery.html", cards=cards, total=len(rows))


# Size in pixels and JPEG quality, which bound the size of the page.
_WIDTH, _HEIGHT, _QUALITY = 160, 120, 75
# Red, green, blue of the transparent background, of points (a grey for light and dark mode), of points on the
# board, and of the sensor.
_PALETTE = bytes([0, 0, 0, 118, 128, 140, 245, 150, 0, 0, 114, 178])
_POINT, _BOARD, _SENSOR = 1, 2, 3
# Percentage of the nearest points of a scan that fill its thumbnail.
_NEAR_PERCENT = 92

_Canvas = NDArray[np.uint8]
"""(_HEIGHT, _WIDTH) indices of colours."""


def render_thumbnail(taken: Snapshot, board: Array) -> str:
    """A thumbnail as a data URL; empty where there is nothing to show.

    Args:
        taken: the measurement.
        board: (M, 3) points that were detected as the board, m.
    """
    if taken.image:
        return _data_url("image/jpeg", _shrink_jpeg(taken.image))
    if not len(taken.points):
        return ""
    points = taken.points.astype(np.float64)
    canvas = _draw_scan(points, board) if np.ptp(points[:, 2]) < 1e-6 else _draw_cloud(points, board)
    return _data_url("image/png", _encode_png(canvas))


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{b64encode(data).decode()}"


def _shrink_jpeg(image: bytes) -> bytes:
    """A JPEG at reduced size; a damaged one is left unchanged, and the browser reports it."""
    decoded = cv2.imdecode(np.frombuffer(image, dtype=np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
    if decoded is None:
        return image
    size = _WIDTH, max(round(decoded.shape[0] * _WIDTH / decoded.shape[1]), 1)
    small = cv2.resize(decoded, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _draw_scan(points: Array, board: Array) -> _Canvas:
    """A scan in top view, x upwards, with the scanner among its points."""
    points, board, origin = points[:, :2], board[:, :2], np.zeros((1, 2))
    ranges = np.linalg.norm(points, axis=1)
    shown = np.concatenate([points[ranges <= np.percentile(ranges, _NEAR_PERCENT)], board, origin])
    middle, size = (shown.max(axis=0) + shown.min(axis=0)) / 2, np.maximum(np.ptp(shown, axis=0), 0.1)
    scale = np.min(np.array([_HEIGHT - 8, _WIDTH - 8]) / size)
    layers = ((points, _POINT, 0), (board, _BOARD, 1), (origin, _SENSOR, 3))
    canvas = np.zeros((_HEIGHT, _WIDTH), dtype=np.uint8)
    for at, color, radius in layers:
        _draw_points(canvas, np.array([_WIDTH, _HEIGHT]) / 2 - scale * (at - middle)[:, ::-1], color, radius)
    return canvas


def _draw_cloud(points: Array, board: Array) -> _Canvas:
    """A cloud as viewed by the LiDAR: azimuth from behind over the left to the front, and elevation."""
    directions = _spherical_angles(points)
    low, high = np.percentile(directions[:, 1], [1, 99])
    span = np.array([-2 * np.pi, min(low - high, -0.2)])
    canvas = np.zeros((_HEIGHT, _WIDTH), dtype=np.uint8)
    for at, color, radius in ((directions, _POINT, 0), (_spherical_angles(board), _BOARD, 1)):
        _draw_points(canvas, (at - [np.pi, high]) / span * [_WIDTH, _HEIGHT - 8] + [0, 4], color, radius)
    return canvas


def _spherical_angles(points: Array) -> Array:
    """(N, 2) azimuth and elevation, rad."""
    x, y, z = points.T
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def _draw_points(canvas: _Canvas, at: Array, color: int, radius: int) -> None:
    """Draws squares of 2 radius + 1 pixels around points (N, 2), clipped to the canvas."""
    reach = np.arange(-radius, radius + 1)
    column, row = np.floor(at).astype(np.intp).T[..., None] + reach
    column, row = np.broadcast_arrays(column[:, None], row[..., None])
    inside = (column >= 0) & (column < canvas.shape[1]) & (row >= 0) & (row < canvas.shape[0])
    canvas[row[inside], column[inside]] = color


def _encode_png(canvas: _Canvas) -> bytes:
    """A PNG of four colours, two bits a pixel: a tenth of the time and of the size of a full-colour one."""
    height, width = canvas.shape
    pixels = canvas.reshape(height, -1, 4)
    packed = pixels[..., 0] << 6 | pixels[..., 1] << 4 | pixels[..., 2] << 2 | pixels[..., 3]
    rows = np.pad(packed, ((0, 0), (1, 0))).tobytes()
    head = struct.pack(">IIBBBBB", width, height, 2, 3, 0, 0, 0)
    parts = (
        (b"IHDR", head),
        (b"PLTE", _PALETTE),
        (b"tRNS", b"\0"),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(_png_chunk(*part) for part in parts)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

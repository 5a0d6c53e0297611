"""Previews of messages for report and viewer, within a budget of bytes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.result import Snapshot
from calgraph.rig.captures.holds import Hold
from calgraph.rig.kinds import RIG_KINDS
from calgraph.sensors import Image, LaserScan, Message, PointCloud


@dataclass(frozen=True)
class PreviewSize:
    """The size of the preview of one message."""

    width: int
    """Largest width of an image, px."""
    points: int
    """Most points of a cloud or scan."""


# Small previews suffice to recognise a capture; large ones, of captures spread evenly, show all detail.
_LARGE, _SMALL = PreviewSize(640, 8000), PreviewSize(160, 600)
# Most captures with large previews, and bytes of all large and of all small ones.
_MAX_LARGE = 60
_BUDGETS = {_LARGE: 14e6, _SMALL: 4e6}
_QUALITY = 80
_GOLDEN = (np.sqrt(5) - 1) / 2


def plan_previews(holds: Sequence[Hold], rig: Rig) -> dict[int, PreviewSize]:
    """The size of the previews by capture; captures beyond the budget, spread evenly, have none.

    Of a rig without sensors, as none can detect the board, there are none.
    """
    if not rig.sensors:
        return {}
    large = _sample_indices(len(holds), min(_MAX_LARGE, int(_BUDGETS[_LARGE] / _estimate_bytes(_LARGE, rig))))
    remaining = np.setdiff1d(np.arange(len(holds)), large)
    small = remaining[_sample_indices(len(remaining), int(_BUDGETS[_SMALL] / _estimate_bytes(_SMALL, rig)))]
    chosen = dict.fromkeys(large.tolist(), _LARGE) | dict.fromkeys(small.tolist(), _SMALL)
    return {hold.index: chosen[k] for k, hold in enumerate(holds) if k in chosen}


def _estimate_bytes(size: PreviewSize, rig: Rig) -> float:
    """Estimated bytes of the previews of one capture of all sensors."""
    kinds = (RIG_KINDS[spec.kind] for spec in rig.sensors.values())
    return sum(kind.preview_bytes(size.width, size.points) for kind in kinds)


def make_preview(capture: int, sensor: str, messages: Sequence[Message], size: PreviewSize) -> Snapshot:
    """A preview of the middle one of a sensor's messages of one capture."""
    message = messages[len(messages) // 2]
    preview = Snapshot(capture, sensor, message.stamp)
    if isinstance(message, Image):
        h, w = message.pixels.shape[:2]
        return replace(preview, image=_encode_jpeg(message.pixels, size.width), width=w, height=h)
    if isinstance(message, LaserScan | PointCloud):
        points = message.points[message.valid] if isinstance(message, LaserScan) else message.points
        return replace(preview, points=_subsample_points(points, size.points))
    return preview


def _encode_jpeg(pixels: NDArray[np.uint8], width: int) -> bytes:
    import cv2

    h, w = pixels.shape[:2]
    if w > width:
        # Area averages do not alias the fine pattern of a board.
        pixels = cv2.resize(pixels, (width, max(round(h * width / w), 1)), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _subsample_points(points: Array, limit: int) -> NDArray[np.float32]:
    """At most ``limit`` of points (N, 3), spread evenly over their order.

    A constant stride would alias with the order of rings of a LiDAR and leave some rings out: the place within
    each stride varies by the golden ratio, a low-discrepancy sequence.
    """
    if len(points) > limit:
        stride = len(points) / limit
        offsets = (np.arange(limit) * _GOLDEN) % 1
        points = points[((np.arange(limit) + offsets) * stride).astype(np.intp)]
    return points.astype(np.float32)


def _sample_indices(count: int, limit: int) -> NDArray[np.intp]:
    """At most ``limit`` of ``count`` indices, evenly spaced."""
    return np.linspace(0, count - 1, min(count, limit)).round().astype(np.intp)

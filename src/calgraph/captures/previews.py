"""What is kept of the messages once the board was looked for in them: enough to be shown, within a budget."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.captures.holds import Hold
from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.result import Snapshot
from calgraph.sensors import Image, LaserScan, Message, PointCloud


@dataclass(frozen=True)
class Detail:
    """How much of one message is kept."""

    width: int
    """Of a picture at most, px."""
    points: int
    """Of a cloud or scan at most."""


# In many captures one sees enough to recognise them; in some, spread evenly, all there is to see.
_LARGE, _SMALL = Detail(640, 8000), Detail(160, 600)
# So many captures are kept large at most, as nobody looks at more; and bytes of all that are large, or small.
_MOST_LARGE = 60
_BUDGETS = {_LARGE: 14e6, _SMALL: 4e6}
# Bytes of a JPEG for each pixel (a noisy one), and of a point; beams of a scan.
_PER_PIXEL, _PER_POINT, _BEAMS = 0.2, 12.0, 2000
_QUALITY = 80
_GOLDEN = (np.sqrt(5) - 1) / 2


def details(holds: Sequence[Hold], rig: Rig) -> dict[int, Detail]:
    """By capture how much of it is kept; captures that go beyond the budget are left out, evenly."""
    large = _spread(len(holds), min(_MOST_LARGE, int(_BUDGETS[_LARGE] / _cost(_LARGE, rig))))
    rest = np.setdiff1d(np.arange(len(holds)), large)
    small = rest[_spread(len(rest), int(_BUDGETS[_SMALL] / _cost(_SMALL, rig)))]
    chosen = dict.fromkeys(large.tolist(), _LARGE) | dict.fromkeys(small.tolist(), _SMALL)
    return {hold.index: chosen[k] for k, hold in enumerate(holds) if k in chosen}


def _cost(detail: Detail, rig: Rig) -> float:
    """About how many bytes a capture of all sensors takes."""
    each = {
        "camera": _PER_PIXEL * detail.width * (0.75 * detail.width),
        "lidar3d": _PER_POINT * detail.points,
        "lidar2d": _PER_POINT * min(detail.points, _BEAMS),
    }
    return sum(each[spec.kind] for spec in rig.sensors.values())


def snapshot(capture: int, sensor: str, messages: Sequence[Message], detail: Detail) -> Snapshot:
    """The message in the middle of one sensor's messages of one capture, made small."""
    message = messages[len(messages) // 2]
    taken = Snapshot(capture, sensor, message.stamp)
    if isinstance(message, Image):
        h, w = message.pixels.shape[:2]
        return replace(taken, image=_jpeg(message.pixels, detail.width), width=w, height=h)
    if isinstance(message, LaserScan | PointCloud):
        points = message.points[message.valid] if isinstance(message, LaserScan) else message.points
        return replace(taken, points=_thinned(points, detail.points))
    return taken


def _jpeg(pixels: NDArray[np.uint8], width: int) -> bytes:
    import cv2

    h, w = pixels.shape[:2]
    if w > width:
        # Averages over areas: thin lines of a board fade, but do not turn into others.
        pixels = cv2.resize(pixels, (width, max(round(h * width / w), 1)), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _thinned(points: Array, most: int) -> NDArray[np.float32]:
    """At most so many of points (N, 3), spread evenly over their order.

    Every so many-th point would take some rings of a LiDAR and leave others out, so that each is taken from
    another place within its share: by the golden ratio, which no pattern of the points has in common with it.
    """
    if len(points) > most:
        share = len(points) / most
        inside = (np.arange(most) * _GOLDEN) % 1
        points = points[((np.arange(most) + inside) * share).astype(np.intp)]
    return points.astype(np.float32)


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """At most so many of ``count`` indices, evenly."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)

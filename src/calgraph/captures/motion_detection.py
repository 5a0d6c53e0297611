"""How much a sensor's view changes from one message to the next: holds of the board are where nothing does."""

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.sensors import Image, LaserScan, Message, PointCloud

Signature = NDArray[np.float64] | NDArray[np.int64]
"""What is compared of a message: grey values, ranges, or the numbers of the cells that are occupied."""

# Clouds are compared by the cells of this size (m) that their points fall into. A point that only crossed into the
# next cell has not moved: noise does that.
_CELL = 0.2
_PACK = np.array([1, 2**21, 2**42])
_WITH_NEIGHBOURS = np.array([0, *_PACK, *-_PACK])


class ActivityMeter:
    """Compares each message of one sensor with the one before."""

    def __init__(self) -> None:
        self._before: Signature | None = None

    def change(self, message: Message) -> float:
        """Share of the view, in 0..1, that differs from the message before; 0 for the first."""
        now = _signature(message)
        before, self._before = self._before, now
        if before is None:
            return 0.0
        if isinstance(message, PointCloud):
            came, went = np.setdiff1d(now, _grown(before)), np.setdiff1d(before, _grown(now))
            return (len(came) + len(went)) / max(len(now) + len(before), 1)
        if now.shape != before.shape:
            return 1.0
        if not now.size:
            return 0.0
        if isinstance(message, Image):
            return float(np.mean(np.abs(now - before) > 12))
        return float(np.mean(np.abs(now - before) > np.maximum(0.05, 0.02 * np.minimum(now, before))))


def _signature(message: Message) -> Signature:
    if isinstance(message, Image):
        height, width = message.gray.shape
        return np.asarray(
            cv2.resize(message.gray, (max(width // 8, 1), max(height // 8, 1)), interpolation=cv2.INTER_AREA),
            dtype=np.float64,
        )
    if isinstance(message, LaserScan):
        # A beam without return is far: one that loses its wall has seen something change.
        return np.where(message.valid, message.ranges, 100.0)
    if isinstance(message, PointCloud):
        cells = np.floor(message.points / _CELL).astype(np.int64) + 2**20
        return np.unique(cells @ _PACK)
    return np.zeros(0)


def _grown(cells: Signature) -> Signature:
    return np.asarray((cells[:, None] + _WITH_NEIGHBOURS).ravel())


def still_spans(stamps: Array, activity: Array) -> Array:
    """Spans in which a sensor's view rests.

    The level between rest and motion is found from the activity itself (Otsu's threshold on its logarithm), as
    noise differs from sensor to sensor.

    Args:
        stamps: (N,) s, ascending.
        activity: (N,) change since the message before, 0..1.

    Returns:
        (S, 2) first and last stamp of runs of messages without change among them.
    """
    if len(stamps) < 3:
        return np.zeros((0, 2))
    level = _otsu(np.log10(activity[1:] + 1e-4))
    moving = np.log10(activity + 1e-4) > level
    moving[0] = False
    edges = np.flatnonzero(moving)
    first = np.concatenate([[0], edges])
    last = np.concatenate([edges - 1, [len(stamps) - 1]])
    return np.stack([stamps[first], stamps[np.maximum(last, first)]], axis=1)[last > first]


def _otsu(values: Array) -> float:
    """The threshold that best splits values into two classes (Otsu 1979)."""
    ordered = np.sort(values)
    n = np.arange(1, len(ordered))
    mean_below = np.cumsum(ordered)[:-1] / n
    mean_above = (ordered.sum() - np.cumsum(ordered)[:-1]) / (len(ordered) - n)
    between = n * (len(ordered) - n) * (mean_above - mean_below) ** 2
    best = int(np.argmax(between))
    return float((ordered[best] + ordered[best + 1]) / 2)

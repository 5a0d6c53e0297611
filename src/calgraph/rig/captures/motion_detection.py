"""How much a sensor's view changes from one message to the next; during a hold of the board nothing does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.sensors import DetectedCorners, Image, LaserScan, Message, PointCloud

Signature = NDArray[np.float64] | NDArray[np.int64]
"""What is compared of a message: grey values, ranges, the keys of occupied cells, or rows of corners."""
Signed = tuple[type[Message], Signature]
"""A message's type and signature."""

# Factors that pack the indices of a cell into one key, 21 bits an axis.
_PACK = np.array([1, 2**21, 2**42])
_WITH_NEIGHBOURS = np.array([0, *_PACK, *-_PACK])


@dataclass(frozen=True, eq=False)
class ActivityBlock:
    """Changes among consecutive messages of one sensor."""

    changes: list[float]
    """As :meth:`ActivityMeter.measure_change`; 0 for the first one with content."""
    start: int | None
    """Index of the first message with content; None if there is none."""
    first: Signed | None
    last: Signed | None
    """The first and the last one with content."""


def measure_block(_shared: None, decoders: Sequence[Callable[[], Message]]) -> ActivityBlock:
    """The changes among messages, from functions that decode them."""
    meter = BlockMeter()
    for decode in decoders:
        meter.add(decode())
    return meter.block()


class BlockMeter:
    """Measures the changes among consecutive messages of one sensor, apart from those before them."""

    def __init__(self) -> None:
        self._meter = ActivityMeter()
        self._changes: list[float] = []
        self._start: int | None = None
        self._first: Signed | None = None

    def add(self, message: Message) -> None:
        """Compares a message with the one before."""
        self._changes.append(self._meter.measure_change(message))
        if self._first is None and self._meter.previous is not None:
            self._start, self._first = len(self._changes) - 1, self._meter.previous

    def block(self) -> ActivityBlock:
        """The changes so far."""
        return ActivityBlock(self._changes, self._start, self._first, self._meter.previous)


# Change of a detected corner, pixels, that counts as motion: five times the noise of detected corners.
_MIN_CORNER_CHANGE = 1.0
# Change of a grey value, averaged over a block, that counts as motion: noise and flicker stay below.
_MIN_GRAY_CHANGE = 12.0
# Change of a range, m, that counts as motion: more than twice the noise of a 2-D scanner (20 mm).
_MIN_RANGE_CHANGE = 0.05
# The same over the smaller of both ranges: noise of ranges and of angles of incidence grows with range.
_MIN_RANGE_CHANGE_RATIO = 0.02


class ActivityMeter:
    """Compares each message of one sensor with the one before."""

    def __init__(self) -> None:
        self.previous: Signed | None = None
        """Of the last message with content."""

    def join(self, block: ActivityBlock) -> list[float]:
        """The changes of the next messages, measured apart from those before."""
        changes = list(block.changes)
        if block.start is not None and block.first is not None:
            changes[block.start] = self._compare_with_previous(block.first)
            self.previous = block.last
        return changes

    def measure_change(self, message: Message) -> float:
        """Share of the view, in 0..1, that differs from the message before; 0 for the first.

        Messages without any return are left out: they are lost data, and no motion.
        """
        if not _has_content(message):
            return 0.0
        return self._compare_with_previous((type(message), _compute_signature(message)))

    def _compare_with_previous(self, signed: Signed) -> float:
        before, self.previous = self.previous, signed
        if before is None:
            return 0.0
        kind, current = signed
        previous = before[1]
        if kind is DetectedCorners:
            return _compare_corners(previous, current, _MIN_CORNER_CHANGE)
        if kind is PointCloud:
            appeared = np.setdiff1d(current, _dilate_cells(previous))
            vanished = np.setdiff1d(previous, _dilate_cells(current))
            return (len(appeared) + len(vanished)) / max(len(current) + len(previous), 1)
        if current.shape != previous.shape:
            return 1.0
        if not current.size:
            return 0.0
        if kind is Image:
            return float(np.mean(np.abs(current - previous) > _MIN_GRAY_CHANGE))
        min_change = _MIN_RANGE_CHANGE_RATIO * np.minimum(current, previous)
        min_change = np.maximum(_MIN_RANGE_CHANGE, min_change)
        return float(np.mean(np.abs(current - previous) > min_change))


def _has_content(message: Message) -> bool:
    if isinstance(message, PointCloud):
        return len(message.points) > 0
    if isinstance(message, DetectedCorners):
        return len(message.pixels) > 0
    return not isinstance(message, LaserScan) or bool(message.valid.any())


# Edge of the blocks of an image that are averaged, pixels: noise of a pixel falls to an eighth.
_IMAGE_BLOCK = 8
# Range of a beam without return, m: farther than any wall, so that a return that appears is a change.
_NO_RETURN_RANGE = 100.0
# Cell by whose occupation two clouds are compared, m: points in cells next to occupied ones have not moved, as
# noise alone takes points across borders of cells.
_CELL = 0.2


def _compute_signature(message: Message) -> Signature:
    if isinstance(message, Image):
        height, width = message.gray.shape
        size = max(width // _IMAGE_BLOCK, 1), max(height // _IMAGE_BLOCK, 1)
        return np.asarray(cv2.resize(message.gray, size, interpolation=cv2.INTER_AREA), dtype=np.float64)
    if isinstance(message, LaserScan):
        # A beam without return counts as far: a return that appears or vanishes is a change.
        return np.where(message.valid, message.ranges, _NO_RETURN_RANGE)
    if isinstance(message, PointCloud):
        cells = np.floor(message.points / _CELL).astype(np.int64) + 2**20
        return np.unique(cells @ _PACK)
    if isinstance(message, DetectedCorners):
        return np.column_stack([message.board_points, message.pixels])
    return np.zeros(0)


def _compare_corners(before: Signature, after: Signature, min_change: float) -> float:
    """Share of the corners (N, 5), positions on the board and pixels, that moved, appeared or vanished."""
    pixels = {tuple(row[:3].tolist()): row[3:] for row in before}
    changes = [
        np.linalg.norm(row[3:] - pixels.pop(key)) if (key := tuple(row[:3].tolist())) in pixels else np.inf
        for row in after
    ]
    return (len(pixels) + sum(change > min_change for change in changes)) / max(len(pixels) + len(changes), 1)


def _dilate_cells(cells: Signature) -> Signature:
    return np.asarray((cells[:, None] + _WITH_NEIGHBOURS).ravel())


# Change of a view, 0..1, added before the logarithm in which rest and motion are separated: less than one beam of
# a thousand, so that views without any change do not dominate.
MIN_ACTIVITY = 1e-4


def find_still_spans(stamps: Array, activity: Array) -> Array:
    """Spans in which a sensor's view rests.

    The level between rest and motion is Otsu's threshold on the logarithm of the activity, as noise differs from
    sensor to sensor.

    Args:
        stamps: (N,) s, ascending.
        activity: (N,) change since the message before, 0..1.

    Returns:
        (S, 2) first and last stamp of runs of messages without change among them.
    """
    if len(stamps) < 3:
        return np.zeros((0, 2))
    level = _compute_otsu_threshold(np.log10(activity[1:] + MIN_ACTIVITY))
    # Where all of the view changes, there is motion, also if that is so all the time.
    moving = (np.log10(activity + MIN_ACTIVITY) > level) | (activity >= 1)
    moving[0] = False
    edges = np.flatnonzero(moving)
    first = np.concatenate([[0], edges])
    last = np.concatenate([edges - 1, [len(stamps) - 1]])
    return np.stack([stamps[first], stamps[np.maximum(last, first)]], axis=1)[last > first]


def _compute_otsu_threshold(values: Array) -> float:
    """The threshold that best splits values into two classes (Otsu 1979)."""
    ordered = np.sort(values)
    n = np.arange(1, len(ordered))
    mean_below = np.cumsum(ordered)[:-1] / n
    mean_above = (ordered.sum() - np.cumsum(ordered)[:-1]) / (len(ordered) - n)
    between = n * (len(ordered) - n) * (mean_above - mean_below) ** 2
    best = int(np.argmax(between))
    return float((ordered[best] + ordered[best + 1]) / 2)

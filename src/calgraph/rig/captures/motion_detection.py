"""How much a sensor's view changes from one message to the next; during a hold of the board nothing does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.rig.kinds import MOTION_SIGNATURES
from calgraph.rig.kinds.rig_kind import Signature
from calgraph.sensors import Message

Signed = tuple[type[Message], Signature]
"""A message's type and signature."""


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
        motion = MOTION_SIGNATURES.get(type(message))
        if motion is None or getattr(message, "is_empty", False):
            return 0.0
        return self._compare_with_previous((type(message), motion.compute(message)))

    def _compare_with_previous(self, signed: Signed) -> float:
        before, self.previous = self.previous, signed
        kind, current = signed
        return 0.0 if before is None else MOTION_SIGNATURES[kind].compare(before[1], current)


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

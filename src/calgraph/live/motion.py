"""Rest and motion of the board while it is recorded, from how much each view changes."""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.geometry import Array
from calgraph.rig.captures.motion_detection import MIN_ACTIVITY, Signed

# Changes are counted in bins of this width in the logarithm (base 10), a fifth of the scatter of noise.
_BIN = 0.02
# Changes of a sensor that are kept: a minute at the highest rate.
_RECENT = 600


@dataclass(frozen=True)
class Rest:
    """A time in which no view changes."""

    start: float
    """When the last view moved, s."""
    measured: Mapping[str, float]
    """By sensor whose messages show motion, the stamp until which they were measured, s."""


@dataclass
class _SensorMotion:
    """The changes of one sensor's view."""

    quiet: Array
    """(B,) number of messages by logarithm of their change, of the time without operator,"""
    others: Array
    """and of all later ones."""
    recent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_RECENT))
    """Stamps and changes of the last messages."""
    previous: Signed | None = None
    """What the next message is to be compared with."""
    level: float = 0.0
    """Change from which the view moves."""


# Least share of a view that is motion: two blocks of an image of 640 x 480 pixels, whose noise changes none.
_MIN_CHANGE = 5e-4
# Minimum number of messages of the time without operator that show the noise: 1 s.
_MIN_QUIET = 10
# Share of the messages with operator whose changes show the noise: boards rest for a larger share of the time.
_QUIET_SHARE = 0.25
# Change over the median change of views at rest from which a view moves: noise of scanners reaches 1.8 times its
# median, and Otsu's threshold on simulated recordings lies between 2.2 and 2.6 times it.
_NOISE_RATIO = 2.5
# Maximum ratio of this noise to that of the time without operator: a board and a person in view of a LiDAR triple
# it, and a board that moves all the time is no noise.
_MAX_NOISE_GROWTH = 4.0
# Minimum number of messages for Otsu's threshold: 6 s of rest and motion.
_MIN_MESSAGES = 60
# Minimum difference of the mean logarithms (base 10) of the changes at rest and in motion, from which Otsu's
# threshold is taken, if it is above the noise: changes of views that only rest, or only move, differ by less.
_MIN_SEPARATION = 0.7


class RestMonitor:
    """Decides from the changes of all views whether the board rests.

    A view moves if it changes more than its noise, which is that of the time without operator at first, and of the
    quietest messages later. When rest and motion have both been measured, Otsu's threshold separates them if it is
    higher: a board that is held by hand never rests completely.
    """

    def __init__(self, sensors: Collection[str]) -> None:
        bins = int(np.ceil(-np.log10(MIN_ACTIVITY) / _BIN)) + 2
        self._centers = np.log10(MIN_ACTIVITY) + _BIN * np.arange(bins)
        self._sensors = {
            name: _SensorMotion(np.zeros(bins), np.zeros(bins), level=_MIN_CHANGE) for name in sensors
        }

    def previous(self, name: str) -> Signed | None:
        """What the next message of a sensor is to be compared with."""
        return self._sensors[name].previous

    def add(
        self, name: str, stamps: Sequence[float], changes: Sequence[float], last: Signed | None, *, quiet: bool
    ) -> None:
        """Adds the changes of consecutive messages of a sensor.

        Args:
            name: of the sensor.
            stamps: of the messages, s.
            changes: 0..1 of each, as :class:`calgraph.rig.captures.motion_detection.ActivityMeter` measures.
            last: what the next message is to be compared with.
            quiet: whether they are of the time without operator.
        """
        motion = self._sensors[name]
        motion.previous = last
        counts = motion.quiet if quiet else motion.others
        for stamp, change in zip(stamps, changes, strict=True):
            motion.recent.append((stamp, change))
            position = (np.log10(change + MIN_ACTIVITY) - self._centers[0]) / _BIN
            counts[min(round(float(position)), len(counts) - 1)] += 1
        motion.level = self._compute_level(motion)

    def level(self, name: str) -> float:
        """The change from which the view of a sensor moves."""
        return self._sensors[name].level

    def is_moving(self, name: str) -> bool:
        """Whether the view of a sensor changed in its last message."""
        motion = self._sensors[name]
        return bool(motion.recent) and self._moves(motion, motion.recent[-1][1])

    def find_rest(self, fast: Collection[str]) -> Rest | None:
        """The rest under way of sensors whose messages show motion; None while a view moves, and without any."""
        motions = {name: self._sensors[name] for name in fast if self._sensors[name].recent}
        if not motions or len(motions) < len(fast) or any(self.is_moving(name) for name in motions):
            return None
        start = max(self._find_last_motion(motion) for motion in motions.values())
        return Rest(start, {name: motion.recent[-1][0] for name, motion in motions.items()})

    def _find_last_motion(self, motion: _SensorMotion) -> float:
        """Stamp of the last message that differs from the one before, or of the first message."""
        return next(
            (stamp for stamp, change in reversed(motion.recent) if self._moves(motion, change)),
            motion.recent[0][0],
        )

    def _moves(self, motion: _SensorMotion, change: float) -> bool:
        # Where all of the view changes, there is motion, also if that is so all the time.
        return change > motion.level or change >= 1

    def _compute_level(self, motion: _SensorMotion) -> float:
        if motion.quiet.sum() < _MIN_QUIET:
            noise = self._find_quantile(motion.quiet + motion.others, _QUIET_SHARE)
        else:
            noise = empty = self._find_quantile(motion.quiet, 0.5)
            if motion.others.sum() >= _MIN_QUIET:
                floor = max(empty, _MIN_CHANGE / _NOISE_RATIO)
                held = self._find_quantile(motion.others, _QUIET_SHARE)
                noise = min(max(empty, held), _MAX_NOISE_GROWTH * floor)
        level = max(_NOISE_RATIO * noise, _MIN_CHANGE)
        if motion.others.sum() < _MIN_MESSAGES:
            return level
        # What is below the noise is rest, however far: views without any change do not set the threshold.
        lowest = float(np.log10(level + MIN_ACTIVITY))
        otsu, separation = _split(np.maximum(self._centers, lowest), motion.others)
        if separation < _MIN_SEPARATION:
            return level
        return max(level, 10**otsu - MIN_ACTIVITY)

    def _find_quantile(self, counts: Array, share: float) -> float:
        at = int(np.searchsorted(np.cumsum(counts), share * counts.sum()))
        return float(10 ** self._centers[at] - MIN_ACTIVITY)


def _split(centers: Array, counts: Array) -> tuple[float, float]:
    """Otsu's threshold of a histogram (Otsu 1979), and the difference of the means of its two classes."""
    centers, place = np.unique(centers[counts > 0], return_inverse=True)
    counts = np.bincount(place, counts[counts > 0]).astype(np.float64)
    if len(centers) < 2:
        return 0.0, 0.0
    below = np.cumsum(counts)[:-1]
    above = counts.sum() - below
    sums = np.cumsum(counts * centers)
    difference = (sums[-1] - sums[:-1]) / above - sums[:-1] / below
    best = int(np.argmax(below * above * difference**2))
    return float((centers[best] + centers[best + 1]) / 2), float(difference[best])

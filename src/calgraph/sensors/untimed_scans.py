"""Scans whose messages do not state the time from beam to beam, of scanners that may turn nevertheless.

Where things move, other sensors show it: what a scanner measures at a time ``s u`` after the stamp is farther on
its way, where u is the time in which a mirror turns from the first beam to the bearing of the thing; s is 1 for
scanners that turn, -1 for those that turn against the order of their beams, and 0 where beams are simultaneous.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array

# Standard deviations from 0, 1 and -1 within which s is one of them, 1 % of right ones are beyond; and beyond
# which it is not, 0.05 % are.
_MAX_SIGMAS, _MIN_SIGMAS = 2.5, 3.5


@dataclass(frozen=True)
class UntimedScans:
    """Scans whose messages do not state the time from beam to beam."""

    first_angle: float
    """Of the first beam, rad."""
    step: float
    """From one beam to the next, rad, with sign."""
    period: float
    """From one scan to the next, s."""

    @classmethod
    def from_angles(cls, angles: Array, period: float) -> "UntimedScans":
        """Of beams at angles (B,), in the order in which they are measured if the scanner turns; two or more."""
        return cls(float(angles[0]), float(angles[-1] - angles[0]) / (len(angles) - 1), period)

    @property
    def increment(self) -> float:
        """Time from beam to beam of a scanner that turns once a scan, s."""
        return self.period * abs(self.step) / (2 * np.pi)

    def turn_times(self, angles: Array) -> Array:
        """Times after the first beam at which a scanner that turns once a scan measures at angles (N,), s."""
        turned = (angles - self.first_angle) * np.sign(self.step) % (2 * np.pi)
        return np.asarray(self.period * turned / (2 * np.pi), dtype=np.float64)


def decide_turn(value: float, stddev: float) -> int | None:
    """Which of 1, 0 and -1 an estimate of s is; None where it may be several, or is none of them."""
    sigmas = {turn: abs(value - turn) / max(stddev, 1e-3) for turn in (-1, 0, 1)}
    best = min(sigmas, key=lambda turn: sigmas[turn])
    firm = sigmas[best] < _MAX_SIGMAS and all(sigmas[turn] > _MIN_SIGMAS for turn in sigmas if turn != best)
    return best if firm else None


def describe_turning(sensors: Iterable[str], periods: Iterable[float], moving: str) -> str:
    """The finding that scanners turn whose scans have no times: with periods, s, of what moves."""
    turns = " or ".join(sorted({f"{1e3 * period:.0f}" for period in periods}))
    return (
        f"the scans of {', '.join(sensors)} have no times of beams (time_increment is 0), but {moving} where "
        f"scanners that turn in {turns} ms measure them: beams are taken to be measured one after the other; set "
        "time_increment in the drivers"
    )

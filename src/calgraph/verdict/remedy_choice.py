"""Which measures to state as remedies: cheap ones that suffice first, and few."""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Protocol, Self, TypeVar

import numpy as np

from calgraph.geometry import Array

# Least decrease of the worst standard deviation over its limit by a remedy that does not suffice.
_MIN_DECREASE = 0.1
PROMISED_SHARE = 0.9
"""Of the limit, what further data should leave: the next calibration of simulated rigs states up to 1.1 of the
predicted standard deviation in 95 %; of networks and the real VLP-16, 1.3, which this does not cover ("Remedies"
in docs/benchmarks.md)."""
# Remedies of one sensor: more are not read.
_MAX_REMEDIES = 3


class Measure(Protocol):
    """What an operator may do."""

    @property
    def minutes(self) -> float:
        """Of the operator, by which remedies are ranked."""
        ...

    def __add__(self, other: Self, /) -> Self:
        """Both together."""
        ...


M = TypeVar("M", bound=Measure)
T = TypeVar("T")
D = TypeVar("D")


def choose_axis(before: Array, after: Array, limits: Array) -> int:
    """The axis whose gain is stated: the least certain one now, or another that alone is too uncertain afterwards.

    Args:
        before: (6,) standard deviations of a sensor,
        after: and those with a remedy.
        limits: (6,) of these.
    """
    axis = int(np.argmax(before / limits))
    return axis if after[axis] > limits[axis] or np.all(after <= limits) else int(np.argmax(after / limits))


def choose_amount(amounts: Sequence[T], excess: Callable[[T], float], otherwise: D) -> T | D:
    """Of amounts of further data, ascending, the least that suffices with a reserve, or else without one.

    Args:
        amounts: to choose from.
        excess: the worst standard deviation after an amount over its limit.
        otherwise: where none suffices.
    """
    return next((one for most in (PROMISED_SHARE, 1) for one in amounts if excess(one) <= most), otherwise)


def choose_measures(measures: Sequence[M], excess: Callable[[M], float], now: float) -> list[M]:
    """The cheapest measures that suffice, of two where no single one does; otherwise the best ones.

    Args:
        measures: to choose from.
        excess: the worst standard deviation after a measure over its limit,
        now: and the present one.
    """
    single = [one for one in measures if excess(one) <= max((1 - _MIN_DECREASE) * now, 1)]
    enough = sorted((one for one in single if excess(one) <= 1), key=lambda one: one.minutes)
    if not enough:
        together = [a + b for a, b in combinations(single, 2)]
        enough = sorted((one for one in together if excess(one) <= 1), key=lambda one: one.minutes)
    others = sorted((one for one in single if one not in enough), key=excess)
    return [*enough, *others][:_MAX_REMEDIES]

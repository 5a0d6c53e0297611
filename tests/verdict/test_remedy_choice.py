"""Which remedies are stated, and of which axis."""

from dataclasses import dataclass

import numpy as np
import pytest

from calgraph.verdict.remedy_choice import choose_amount, choose_axis, choose_measures


@dataclass(frozen=True)
class Measured:
    """A measure that divides what exceeds the limit."""

    name: str
    minutes: float
    divisor: float

    def __add__(self, other: "Measured") -> "Measured":
        return Measured(f"{self.name}+{other.name}", self.minutes + other.minutes, self.divisor * other.divisor)


def choose(now: float, *measures: Measured) -> list[str]:
    return [one.name for one in choose_measures(measures, lambda one: now / one.divisor, now)]


def test_the_cheapest_that_suffices_comes_first_and_the_best_of_others_follow() -> None:
    measures = [Measured("a", 9, 2.1), Measured("b", 5, 2), Measured("c", 1, 1.2), Measured("d", 1, 1.3)]
    assert choose(2.0, *measures) == ["b", "a", "d"]


def test_two_are_taken_together_where_no_single_one_suffices() -> None:
    measures = [Measured("a", 9, 1.8), Measured("b", 5, 1.5), Measured("c", 1, 1.4)]
    assert choose(2.0, *measures) == ["b+c", "a+c", "a+b"]


@pytest.mark.parametrize(
    ("now", "name"),
    [
        (1.9, "thrice"),  # twice as many: 0.95 of the limit
        (1.7, "twice"),
        (2.9, "thrice"),  # without a reserve: there is no more
        (4.0, "other"),
    ],
)
def test_the_least_amount_that_suffices_with_a_reserve_is_taken(now: float, name: str) -> None:
    amounts = [Measured("twice", 1, 2), Measured("thrice", 2, 3)]
    assert choose_amount(amounts, lambda one: now / one.divisor, Measured("other", 9, 1)).name == name


def test_a_measure_with_little_effect_is_none() -> None:
    """At least a tenth."""
    assert choose(3.0, Measured("a", 1, 1.1)) == []
    assert choose(3.0, Measured("a", 1, 1.12)) == ["a"]


@pytest.mark.parametrize(
    ("after", "axis"),
    [
        ((0.2, 0.6, 0.3), 1),  # all suffice: the gain of the axis that was the least certain
        ((0.2, 1.1, 1.5), 1),  # it remains too uncertain
        ((0.2, 0.9, 1.5), 2),  # another one does
    ],
)
def test_the_gain_is_that_of_the_least_certain_axis_if_that_is_no_promise(
    after: tuple[float, float, float], axis: int
) -> None:
    limits = np.array([1.0, 2.0, 1.0])
    assert choose_axis(np.array([1.1, 6.0, 2.0]), limits * after, limits) == axis

"""Score tests of changes in time: found, measured, and not found where there are none."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.geometry import Array
from calgraph.solver.change_tests import PeriodEquations, search_changes

PERIODS = 12
STEPS: list[Array] = [np.asarray(np.arange(PERIODS) >= k, dtype=np.float64) for k in range(2, PERIODS - 2)]


def equations_of(values: Array) -> PeriodEquations:
    """Of one number that is measured once a period with a standard deviation of 1 mm, and is constant."""
    measured = values - values.mean()
    return PeriodEquations(
        1e6 * np.eye(PERIODS), -1e6 * measured, np.arange(PERIODS), np.ones((PERIODS, 1)), np.ones(1), np.zeros(1)
    )


def search(values: Array) -> list[tuple[int, Array]]:
    directions = [step[:, None] for step in STEPS]
    return [
        (number, tests[number].size) for number, tests in search_changes(equations_of(values), directions, 3, 0.05)
    ]


def test_noise_alone_is_hardly_ever_a_change() -> None:
    """With the scatter of twelve periods the statistic has an F distribution: 8 steps, each 0.003 beyond 15."""
    found = [search(np.random.default_rng(seed).normal(0, 0.001, PERIODS)) for seed in range(400)]
    assert sum(map(bool, found)) <= 12


def test_two_steps_are_found_the_larger_first() -> None:
    noise = np.random.default_rng(0).normal(0, 0.001, PERIODS)
    (first, size), (second, other) = search(noise + 0.2 * STEPS[5] - 0.05 * STEPS[1])
    assert (first, second) == (5, 1)
    assert_allclose(other, [-0.05], atol=0.003)
    # Before the other is known.
    assert 0.1 < size[0] < 0.2


def test_the_gradient_of_what_is_constant_does_not_matter() -> None:
    """The model moves to its minimum before changes are tested."""
    equations = equations_of(np.zeros(PERIODS))
    moved = PeriodEquations(**{**vars(equations), "gradient": equations.gradient + 1e6})
    assert list(search_changes(moved, [step[:, None] for step in STEPS], 3, 0.05)) == []

"""The engine of processes."""

import pytest

from calgraph.engine import Engine, Processes


def double_and_keep(number: int) -> tuple[int, list[int]]:
    return 2 * number, [number]


def add(kept: list[int], number: int) -> int:
    return kept[0] + number


@pytest.mark.parametrize("jobs", [1, 2])
def test_values_that_are_kept_are_arguments_of_later_calls(jobs: int) -> None:
    engine: Engine = Processes(jobs)
    numbers = engine.put([1, 2, 3])
    results, kept = engine.map_and_keep(double_and_keep, [(n,) for n in numbers])
    assert results == [2, 4, 6]
    assert engine.map(add, [(value, 10) for value in kept]) == [11, 12, 13]

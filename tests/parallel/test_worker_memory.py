"""Workers with little memory."""

import os

import numpy as np
import pytest

from calgraph.config.settings import DaskSettings
from calgraph.geometry import Array
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.open_cluster import open_cluster

pytestmark = pytest.mark.slow

SIZE = 10_000_000


def make_numbers(value: int) -> Array:
    return np.full(SIZE, float(value))


def take_last(numbers: Array) -> tuple[int, float]:
    return os.getpid(), float(numbers[-1])


def test_values_beyond_the_memory_of_a_worker_are_kept_on_disk() -> None:
    with open_cluster("local", 1, DaskSettings(worker_memory=1.0)) as engine:
        kept = [Kept(make_numbers, n) for n in range(20)]
        (process, _), *_ = engine.map(take_last, [(numbers,) for numbers in kept])
        # In the same process, which was not ended.
        assert list(engine.map(take_last, [(numbers,) for numbers in kept])) == [(process, n) for n in range(20)]

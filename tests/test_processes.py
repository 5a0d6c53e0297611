"""Parallel evaluation in processes."""

import math
import multiprocessing
import os
import signal

import pytest

from calgraph.errors import CalibrationError, InputError
from calgraph.processes import parallel_map


def refused(number: int) -> int:
    raise InputError(f"sensors.{number}: is upside down")


def killed(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("jobs", [1, 2, 8])
def test_results_come_in_the_order_of_the_work(jobs: int) -> None:
    reported: list[float] = []
    assert parallel_map(math.factorial, [(k,) for k in range(5)], jobs, reported.append) == [1, 1, 2, 6, 24]
    assert reported == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_no_work_has_no_results() -> None:
    assert parallel_map(math.factorial, [], 2) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_keeps_its_type_and_message(jobs: int) -> None:
    with pytest.raises(InputError, match=r"^sensors\.1: is upside down$"):
        parallel_map(refused, [(1,), (1,)], jobs)
    assert multiprocessing.active_children() == []


def test_a_killed_process_is_reported() -> None:
    with pytest.raises(CalibrationError, match=r"killed.*reduce `jobs`"):
        parallel_map(killed, [(1,), (2,)], 2)

"""Work shared by processes."""

import math
import multiprocessing
import os
import signal

import pytest

from calgraph.errors import CalibrationError, InputError
from calgraph.processes import side_by_side


def refused(number: int) -> int:
    raise InputError(f"sensors.{number}: is upside down")


def killed(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("jobs", [1, 2, 8])
def test_results_come_in_the_order_of_the_work(jobs: int) -> None:
    told: list[float] = []
    assert side_by_side(math.factorial, [(k,) for k in range(5)], jobs, told.append) == [1, 1, 2, 6, 24]
    assert told == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_no_work_has_no_results() -> None:
    assert side_by_side(math.factorial, [], 2) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_keeps_its_kind_and_words(jobs: int) -> None:
    with pytest.raises(InputError, match=r"^sensors\.1: is upside down$"):
        side_by_side(refused, [(1,), (1,)], jobs)
    assert multiprocessing.active_children() == []


def test_a_process_that_is_killed_is_said() -> None:
    with pytest.raises(CalibrationError, match=r"killed.*--jobs 1"):
        side_by_side(killed, [(1,), (2,)], 2)

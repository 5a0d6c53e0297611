"""The engine of processes, and its workers that stay."""

import os
import signal
from collections.abc import Iterator

import pytest

from calgraph.errors import WorkerKilledError
from calgraph.parallel.engine import Engine, MapEngine, Processes


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


def keep_process(number: int) -> tuple[int, int]:
    """The number, and the process that has been called."""
    return number, os.getpid()


def compare_process(process: int) -> bool:
    return process == os.getpid()


def name_processes(*processes: int) -> tuple[int, ...]:
    return processes


def divide(number: int) -> float:
    return 1 / number


def make_function(_number: int) -> object:
    return lambda: None


class Noted:
    """Counts the copies of itself that a process has."""

    copies = 0

    def __init__(self) -> None:
        Noted.copies += 1

    def __setstate__(self, _state: object) -> None:
        Noted.copies += 1

    def __del__(self) -> None:
        Noted.copies -= 1


def keep_noted(_number: int) -> tuple[None, Noted]:
    return None, Noted()


def count_copies(_number: int) -> tuple[int, int]:
    return os.getpid(), Noted.copies


def end_process(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.fixture
def workers() -> Iterator[MapEngine]:
    with Processes(2).keep_workers(10**6) as started:
        yield started


def test_workers_are_as_many_as_processes(workers: MapEngine) -> None:
    assert workers.workers == 2


def test_workers_return_results_in_the_order_of_the_work(workers: MapEngine) -> None:
    assert workers.map(divide, [(n,) for n in range(1, 40)]) == [1 / n for n in range(1, 40)]


def test_workers_give_calls_the_values_that_were_put(workers: MapEngine) -> None:
    numbers = workers.put([1, 2, 4])
    assert workers.map(divide, [(n,) for n in numbers]) == [1, 0.5, 0.25]


def test_workers_do_calls_where_their_values_are_kept(workers: MapEngine) -> None:
    _, kept = workers.map_and_keep(keep_process, [(n,) for n in range(8)])
    assert workers.map(compare_process, [(process,) for process in kept]) == [True] * 8


def test_workers_give_a_call_values_of_different_processes(workers: MapEngine) -> None:
    _, kept = workers.map_and_keep(keep_process, [(n,) for n in range(8)])
    processes = workers.map(name_processes, [(process,) for process in kept])
    one, other = (kept[[own for (own,) in processes].index(process)] for process in {own for (own,) in processes})
    assert set(workers.map(name_processes, [(one, other)])[0]) == {own for (own,) in processes}


def test_workers_forget_values_without_handles(workers: MapEngine) -> None:
    _, kept = workers.map_and_keep(keep_noted, [(n,) for n in range(8)])
    before = dict(workers.map(count_copies, [(n,) for n in range(40)]))
    del kept
    after = dict(workers.map(count_copies, [(n,) for n in range(40)]))
    assert (sum(before.values()), sum(after.values())) == (8, 0)


def test_workers_raise_what_a_call_raises(workers: MapEngine) -> None:
    with pytest.raises(ZeroDivisionError, match="division by zero") as raised:
        workers.map(divide, [(0,)])
    assert "in divide" in raised.value.__notes__[0]


def test_workers_work_after_a_call_that_fails(workers: MapEngine) -> None:
    with pytest.raises(ZeroDivisionError):
        workers.map(divide, [(n,) for n in range(9)])
    assert workers.map(divide, [(n,) for n in (1, 2, 4)]) == [1, 0.5, 0.25]


def test_workers_raise_errors_of_results_that_cannot_be_sent(workers: MapEngine) -> None:
    with pytest.raises(Exception, match="make_function"):
        workers.map(make_function, [(0,)])


def test_workers_report_a_process_that_was_killed(workers: MapEngine) -> None:
    with pytest.raises(WorkerKilledError, match="a process was killed"):
        workers.map(end_process, [(n,) for n in range(4)])


def test_workers_end_with_the_block() -> None:
    with Processes(2).keep_workers(10**6) as workers:
        ((process, _), *_) = workers.map(count_copies, [(0,)])
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_one_process_has_no_workers() -> None:
    with Processes(1).keep_workers(10**6) as workers:
        assert workers.map(compare_process, [(os.getpid(),)]) == [True]

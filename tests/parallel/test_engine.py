"""The engine of processes, and its workers that stay."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from calgraph.errors import WorkerKilledError
from calgraph.parallel.engine import Engine, MapEngine, Processes
from calgraph.parallel.kept_values import Kept


def double(numbers: list[int]) -> list[int]:
    return [2 * number for number in numbers]


def add(kept: list[int], number: int) -> int:
    return kept[0] + number


@pytest.mark.parametrize("jobs", [1, 2])
def test_kept_values_are_arguments_of_calls_and_of_further_values(jobs: int) -> None:
    engine: Engine = Processes(jobs)
    kept = [Kept.of([n]) for n in (1, 2, 3)]
    assert list(engine.map(add, [(one, 10) for one in kept])) == [11, 12, 13]
    doubled = [Kept(double, one) for one in kept]
    assert list(engine.map(add, [(one, 10) for one in doubled])) == [12, 14, 16]
    assert list(engine.map(add, ((Kept(double, one), 10) for one in doubled))) == [14, 18, 22]


def get_process() -> int:
    return os.getpid()


def compare_process(process: int) -> bool:
    return process == os.getpid()


def identify(number: int) -> int:
    return number


def add_numbers(*numbers: int) -> int:
    return sum(numbers)


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


def count_copies(*_values: object) -> tuple[int, int]:
    return os.getpid(), Noted.copies


def end_process(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def end_process_once(folder: Path, value: int, number: int) -> int:
    """The sum; the first call with 3 kills its process."""
    if number == 3 and not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value + number


def notice_others(folder: Path, number: int) -> int:
    """How many calls run; the first call with 3 kills its process."""
    own = folder / f"running-{number}"
    own.touch()
    if number == 3 and not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    running = len(list(folder.glob("running-*")))
    own.unlink()
    return running


@pytest.fixture
def workers() -> Iterator[MapEngine]:
    with Processes(2).keep_workers(10**6) as started:
        yield started


def test_workers_are_as_many_as_processes(workers: MapEngine) -> None:
    assert workers.workers == 2


def test_workers_return_results_in_the_order_of_the_work(workers: MapEngine) -> None:
    assert list(workers.map(divide, [(n,) for n in range(1, 40)])) == [1 / n for n in range(1, 40)]


def test_workers_do_calls_where_their_values_are_kept(workers: MapEngine) -> None:
    kept = [Kept(get_process) for _ in range(8)]
    assert list(workers.map(compare_process, [(process,) for process in kept])) == [True] * 8
    assert len(set(workers.map(identify, [(process,) for process in kept]))) == 2
    # Values that are computed from them are computed there.
    further = [Kept(compare_process, process) for process in kept]
    assert list(workers.map(identify, [(one,) for one in further])) == [True] * 8


def test_workers_give_a_call_values_of_different_processes(workers: MapEngine) -> None:
    kept = [Kept(add_numbers, n, 1) for n in range(8)]
    assert list(workers.map(identify, [(one,) for one in kept])) == list(range(1, 9))
    assert list(workers.map(add_numbers, [tuple(kept)])) == [36]


def test_maps_whose_results_are_taken_in_turns_do_not_mix(workers: MapEngine) -> None:
    some, others = (workers.map(identify, ((n,) for n in range(first, first + 9))) for first in (0, 100))
    assert list(zip(some, others, strict=True)) == [(n, 100 + n) for n in range(9)]


def test_a_map_whose_results_are_not_taken_does_not_disturb_the_next_one(workers: MapEngine) -> None:
    assert next(workers.map(identify, [(n,) for n in range(9)])) == 0
    assert list(workers.map(divide, [(n,) for n in (1, 2, 4)])) == [1, 0.5, 0.25]


def test_workers_forget_values_that_no_longer_exist(workers: MapEngine) -> None:
    def count_in_all() -> int:
        counts: dict[int, int] = {}
        while len(counts) < workers.workers:
            counts |= dict(workers.map(count_copies, [(n,) for n in range(40)]))
        return sum(counts.values())

    kept = [Kept(Noted) for _ in range(8)]
    list(workers.map(count_copies, [(one,) for one in kept]))
    assert count_in_all() == 8
    del kept
    assert count_in_all() == 0


def test_workers_raise_what_a_call_raises(workers: MapEngine) -> None:
    with pytest.raises(ZeroDivisionError, match="division by zero") as raised:
        list(workers.map(divide, [(0,)]))
    assert "in divide" in raised.value.__notes__[0]


def test_workers_work_after_a_call_that_fails(workers: MapEngine) -> None:
    with pytest.raises(ZeroDivisionError):
        list(workers.map(divide, [(n,) for n in range(9)]))
    assert list(workers.map(divide, [(n,) for n in (1, 2, 4)])) == [1, 0.5, 0.25]


def test_workers_raise_errors_of_results_that_cannot_be_sent(workers: MapEngine) -> None:
    with pytest.raises(Exception, match="make_function"):
        list(workers.map(make_function, [(0,)]))


def test_workers_report_a_call_whose_process_is_killed_again(workers: MapEngine) -> None:
    results = workers.map(end_process, [(n,) for n in range(4)])
    assert next(results) == 0
    with pytest.raises(WorkerKilledError, match="a process was killed"):
        next(results)
    assert list(workers.map(divide, [(n,) for n in (1, 2, 4)])) == [1, 0.5, 0.25]


def test_workers_repeat_the_call_of_a_killed_process_and_compute_its_values_again(
    workers: MapEngine, tmp_path: Path
) -> None:
    kept = [Kept(add_numbers, n, 100) for n in range(8)]
    assert list(workers.map(identify, [(one,) for one in kept])) == list(range(100, 108))
    work = [(tmp_path, one, n) for n, one in enumerate(kept)]
    assert list(workers.map(end_process_once, work)) == [100 + 2 * n for n in range(8)]
    assert (tmp_path / "killed").exists()


def test_workers_replace_a_process_that_is_killed_between_calls(workers: MapEngine) -> None:
    kept = [Kept(add_numbers, n, 100) for n in range(8)]
    for process in set(workers.map(count_copies, [(one,) for one in kept])):
        os.kill(process[0], signal.SIGKILL)
    assert list(workers.map(identify, [(one,) for one in kept])) == list(range(100, 108))


@pytest.mark.parametrize("stay", [False, True])
def test_a_call_is_repeated_while_no_other_one_runs(tmp_path: Path, stay: bool) -> None:
    with Processes(3).keep_workers(10**6) if stay else nullcontext(Processes(3)) as engine:
        running = list(engine.map(notice_others, [(tmp_path, n) for n in range(9)]))
    assert running[3] == 1
    assert max(running) > 1


def test_workers_end_with_the_block() -> None:
    with Processes(2).keep_workers(10**6) as workers:
        ((process, _),) = workers.map(count_copies, [(0,)])
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_one_process_has_no_workers() -> None:
    with Processes(1).keep_workers(10**6) as workers:
        assert list(workers.map(compare_process, [(os.getpid(),)])) == [True]

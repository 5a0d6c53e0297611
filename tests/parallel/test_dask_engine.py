"""Calls on a cluster of this machine."""

import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Future

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.open_cluster import DaskEngine, open_cluster

SETTINGS = DaskSettings(max_lost_workers=1)


@pytest.fixture(scope="module")
def engine() -> Iterator[DaskEngine]:
    with open_cluster("local", 2, SETTINGS, dashboard=False) as opened:
        yield opened


def refuse(number: int) -> int:
    raise InputError(f"sensors.{number}: is upside down")


def end_worker_once(folder: Path, number: int) -> int:
    """The square; the first call with 3 kills its process."""
    if number == 3 and not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def end_worker(_number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def read_process(_number: int) -> int:
    time.sleep(0.05)
    return os.getpid()


def add(shared: list[int], number: int) -> int:
    return shared[0] + number


def add_unless_three(shared: int, number: int) -> int:
    if number == 3:
        raise InputError("sensors.3: is upside down")
    return shared + number


def touch_file(folder: Path, number: int) -> int:
    (folder / str(number)).touch()
    return number


def multiply(numbers: list[int], factor: int) -> list[int]:
    return [factor * number for number in numbers]


def test_results_come_in_the_order_of_the_work(engine: DaskEngine) -> None:
    assert list(engine.map(math.factorial, [(k,) for k in range(5)])) == [1, 1, 2, 6, 24]
    assert list(engine.map(math.factorial, [])) == []


def test_calls_run_in_other_processes(engine: DaskEngine) -> None:
    assert engine.workers == 2
    found = set(engine.map(read_process, [(k,) for k in range(8)]))
    assert len(found) == 2
    assert os.getpid() not in found


def test_an_error_keeps_its_type_and_message(engine: DaskEngine) -> None:
    with pytest.raises(InputError, match=r"^sensors\.1: is upside down$"):
        list(engine.map(refuse, [(1,), (1,)]))


def test_a_stream_is_read_little_ahead_and_keeps_its_order(engine: DaskEngine, tmp_path: Path) -> None:
    unfinished: list[int] = []

    def work() -> Iterator[tuple[Path, int]]:
        for number in range(60):
            unfinished.append(number - len(list(tmp_path.iterdir())))
            yield tmp_path, number

    assert list(engine.map(touch_file, work())) == list(range(60))
    assert max(unfinished) < 4 * 2


def test_results_of_calls_that_finish_while_the_engine_looks_are_not_lost(
    engine: DaskEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Future.status.fget

    def read_slowly(future: Future) -> str:
        status: str = read(future)
        time.sleep(0.02)  # in which a thread of the client receives that calls have finished
        return status

    monkeypatch.setattr(Future, "status", property(read_slowly))
    assert list(engine.map(multiply, (([k], 2) for k in range(20)))) == [[2 * k] for k in range(20)]


def test_results_of_a_stream_come_before_the_error_of_a_call(engine: DaskEngine) -> None:
    stream = engine.map(add_unless_three, ((10, k) for k in range(1, 6)))
    assert [next(stream), next(stream)] == [11, 12]
    with pytest.raises(InputError, match=r"^sensors\.3: is upside down$"):
        next(stream)


def test_results_of_a_stream_come_before_the_error_of_its_source(engine: DaskEngine) -> None:
    def work() -> Iterator[tuple[list[int], int]]:
        yield [10], 1
        raise InputError("recording: is damaged")

    stream = engine.map(add, work())
    assert next(stream) == 11
    with pytest.raises(InputError, match="recording: is damaged"):
        next(stream)


def test_kept_values_are_arguments(engine: DaskEngine) -> None:
    ten, twenty = Kept.of([10]), Kept.of([20])
    assert list(engine.map(add, [(ten, 1), (twenty, 2), (ten, 3)])) == [11, 22, 13]
    computed = [Kept(multiply, one, 5) for one in (ten, twenty)]
    assert list(engine.map(add, [(kept, 0) for kept in computed])) == [50, 100]


def test_calls_of_a_lost_worker_are_repeated(engine: DaskEngine, tmp_path: Path) -> None:
    folder = Kept.of(tmp_path)
    kept = [Kept(multiply, [k], 10) for k in range(4)]
    assert list(engine.map(add, [(one, 0) for one in kept])) == [0, 10, 20, 30]
    assert list(engine.map(end_worker_once, [(folder, k) for k in range(8)])) == [k * k for k in range(8)]
    assert (tmp_path / "killed").exists()
    # Values that the worker kept are computed again.
    assert list(engine.map(add, [(one, 0) for one in kept])) == [0, 10, 20, 30]


@pytest.mark.slow
def test_a_call_that_ends_all_workers_is_reported(engine: DaskEngine) -> None:
    with pytest.raises(CalibrationError, match="several workers of the cluster were lost by the same call"):
        list(engine.map(end_worker, [(1,)]))

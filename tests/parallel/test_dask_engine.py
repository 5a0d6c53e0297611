"""Calls on a cluster of this machine."""

import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError
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


def split(number: int) -> tuple[int, list[int]]:
    return number, [10 * number]


def test_results_come_in_the_order_of_the_work(engine: DaskEngine) -> None:
    reported: list[float] = []
    assert engine.map(math.factorial, [(k,) for k in range(5)], reported.append) == [1, 1, 2, 6, 24]
    assert reported == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert engine.map(math.factorial, []) == []


def test_calls_run_in_other_processes(engine: DaskEngine) -> None:
    assert engine.workers == 2
    found = set(engine.map(read_process, [(k,) for k in range(8)]))
    assert len(found) == 2
    assert os.getpid() not in found


def test_an_error_keeps_its_type_and_message(engine: DaskEngine) -> None:
    with pytest.raises(InputError, match=r"^sensors\.1: is upside down$"):
        engine.map(refuse, [(1,), (1,)])


def test_a_stream_is_read_little_ahead_and_keeps_its_order(engine: DaskEngine, tmp_path: Path) -> None:
    unfinished: list[int] = []

    def work() -> Iterator[tuple[int]]:
        for number in range(60):
            unfinished.append(number - len(list(tmp_path.iterdir())))
            yield (number,)

    assert list(engine.stream(touch_file, work(), tmp_path)) == list(range(60))
    assert max(unfinished) < 4 * 2


def test_results_of_a_stream_come_before_the_error_of_a_call(engine: DaskEngine) -> None:
    stream = engine.stream(add_unless_three, ((k,) for k in range(1, 6)), 10)
    assert [next(stream), next(stream)] == [11, 12]
    with pytest.raises(InputError, match=r"^sensors\.3: is upside down$"):
        next(stream)


def test_results_of_a_stream_come_before_the_error_of_its_source(engine: DaskEngine) -> None:
    def work() -> Iterator[tuple[int]]:
        yield (1,)
        raise InputError("recording: is damaged")

    stream = engine.stream(add, work(), [10])
    assert next(stream) == 11
    with pytest.raises(InputError, match="recording: is damaged"):
        next(stream)


def test_handles_stand_for_values(engine: DaskEngine) -> None:
    ten, twenty = engine.put([[10], [20]])
    assert engine.map(add, [(ten, 1), (twenty, 2), (ten, 3)]) == [11, 22, 13]
    results, kept = engine.map_and_keep(split, [(1,), (2,)])
    assert results == [1, 2]
    assert engine.map(add, [(handle, 0) for handle in kept]) == [10, 20]


def test_calls_of_a_lost_worker_are_repeated(engine: DaskEngine, tmp_path: Path) -> None:
    (handle,) = engine.put([tmp_path])
    _, kept = engine.map_and_keep(split, [(k,) for k in range(4)])
    assert engine.map(end_worker_once, [(handle, k) for k in range(8)]) == [k * k for k in range(8)]
    assert (tmp_path / "killed").exists()
    # Values that the worker kept are computed again.
    assert engine.map(add, [(one, 0) for one in kept]) == [0, 10, 20, 30]


@pytest.mark.slow
def test_a_call_that_ends_all_workers_is_reported(engine: DaskEngine) -> None:
    with pytest.raises(CalibrationError, match="several workers of the cluster were lost by the same call"):
        engine.map(end_worker, [(1,)])

"""Parallel evaluation in processes."""

import errno
import math
import multiprocessing
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import FrameType

import pytest

from calgraph.errors import CalibrationError, InputError
from calgraph.parallel import processes
from calgraph.parallel.engine import Processes, parallel_call
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.processes import forked_jobs, worker_pool


def refused(number: int) -> int:
    raise InputError(f"sensors.{number}: is upside down")


def killed(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("jobs", [1, 2, 8])
def test_results_come_in_the_order_of_the_work(jobs: int) -> None:
    assert list(Processes(jobs).map(math.factorial, [(k,) for k in range(5)])) == [1, 1, 2, 6, 24]


def test_short_work_is_divided_only_where_processes_are_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "START_METHOD", "fork")
    assert forked_jobs(4) == 4
    monkeypatch.setattr(processes, "START_METHOD", "spawn")
    assert forked_jobs(4) == 1


def test_no_work_has_no_results() -> None:
    assert list(Processes(2).map(math.factorial, [])) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_keeps_its_type_and_message(jobs: int) -> None:
    with pytest.raises(InputError, match=r"^sensors\.1: is upside down$"):
        list(Processes(jobs).map(refused, [(1,), (1,)]))
    assert multiprocessing.active_children() == []


def test_a_killed_process_is_reported() -> None:
    with pytest.raises(CalibrationError, match=r"killed.*reduce `jobs`"):
        list(Processes(2).map(killed, [(1,), (2,)]))


def describe_process(name: str) -> tuple[str, bool]:
    return name, multiprocessing.parent_process() is not None


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_call_is_in_another_process_if_there_may_be_several(jobs: int) -> None:
    with parallel_call(describe_process, ("camera",), jobs) as result:
        assert result() == ("camera", jobs > 1)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_a_call_is_raised_where_its_result_is_wanted(jobs: int) -> None:
    match = r"^sensors\.1: is upside down$"
    with parallel_call(refused, (1,), jobs) as result, pytest.raises(InputError, match=match):
        result()


def test_a_killed_process_of_a_call_is_reported() -> None:
    with pytest.raises(CalibrationError, match=r"killed.*reduce `jobs`"), parallel_call(killed, (1,), 2) as result:
        result()


def add_unless_three(shared: Callable[[], int], number: int) -> int:
    if number == 3:
        raise InputError("sensors.3: is upside down")
    return shared() + number


def touch_file(folder: Path, number: int) -> int:
    (folder / str(number)).touch()
    return 300 + number


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_a_stream_is_read_little_ahead_and_keeps_its_order(tmp_path: Path, jobs: int) -> None:
    unfinished: list[int] = []

    def work() -> Iterator[tuple[Path, int]]:
        for number in range(10, 60):
            unfinished.append(number - 10 - len(list(tmp_path.iterdir())))
            yield tmp_path, number

    assert list(Processes(jobs).map(touch_file, work())) == list(range(310, 360))
    assert max(unfinished) < (1 if jobs == 1 else 4 * jobs)


def wait_for_last(folder: Path, number: int) -> int:
    """The number; the first call returns after the last one has begun, or -1 after 20 s."""
    if number == 39:
        (folder / "last").touch()
    ends = time.monotonic() + 20
    while number == 10 and not (folder / "last").exists():
        if time.monotonic() > ends:
            return -1
        time.sleep(0.01)
    return number


def test_one_long_call_of_a_stream_does_not_hold_up_the_others(tmp_path: Path) -> None:
    results = list(Processes(2).map(wait_for_last, ((tmp_path, k) for k in range(10, 40))))
    assert results == list(range(10, 40))


def test_a_stream_that_is_not_read_to_its_end_leaves_no_process() -> None:
    results = Processes(2).map(add_unless_three, ((partial(sum, ()), k) for k in range(10, 100)))
    assert [next(results), next(results)] == [10, 11]
    results.close()  # type: ignore[attr-defined]
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("jobs", [1, 3])
@pytest.mark.parametrize("failing", ["call", "stream"])
def test_results_before_an_error_of_a_stream_are_kept(failing: str, jobs: int) -> None:
    def work() -> Iterator[tuple[Kept, int]]:
        zero = Kept.of(partial(sum, ()))
        yield zero, 0
        yield zero, 1
        if failing == "call":
            yield zero, 3
        raise InputError("the file ends too early")

    results = Processes(jobs).map(add_unless_three, work())
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(InputError, match="upside down" if failing == "call" else "ends too early"):
        next(results)
    assert multiprocessing.active_children() == []


def test_a_killed_process_of_a_stream_is_reported() -> None:
    with pytest.raises(CalibrationError, match=r"killed.*reduce `jobs`"):
        list(Processes(2).map(killed, ((k,) for k in range(9))))


@pytest.mark.parametrize("error", [OSError(errno.EROFS, "Read-only file system"), ImportError("no sem_open")])
def test_a_worker_pool_needs_shared_memory(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr("calgraph.parallel.processes.ProcessPoolExecutor", fail)
    with pytest.raises(CalibrationError, match="several processes are not possible here"), worker_pool(2):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")
def test_processes_that_cannot_be_started_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> int:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("os.fork", fail)
    message = r"^processes cannot be started \(Resource temporarily unavailable\); reduce `jobs`$"
    with pytest.raises(CalibrationError, match=message):
        list(Processes(2).map(math.factorial, [(1,), (2,)]))
    with pytest.raises(CalibrationError, match=message), worker_pool(2):
        pass


def test_threads_of_a_worker_pool_that_cannot_be_started_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("calgraph.parallel.processes.ProcessPoolExecutor.submit", fail)
    message = r"^processes cannot be started \(can't start new thread\); reduce `jobs`$"
    with pytest.raises(CalibrationError, match=message), worker_pool(2):
        pass


def map_here(numbers: list[int]) -> list[bool]:
    """Whether each call is in this process."""
    own = os.getpid()
    return [process == own for process in Processes(2).map(get_process, [(number,) for number in numbers])]


def get_process(_number: int) -> int:
    return os.getpid()


def test_a_worker_has_no_processes_of_its_own() -> None:
    assert list(Processes(2).map(map_here, [([1, 2],), ([3, 4],)])) == [[True, True]] * 2


_FEW_FILES = """
import os, resource, time
from calgraph.errors import CalibrationError
from calgraph.parallel.engine import Processes
used = len(os.listdir("/proc/self/fd"))
resource.setrlimit(resource.RLIMIT_NOFILE, (used + {free}, used + {free}))
try:
    list(Processes(40).map(time.sleep, [(5.0,)] * 40))
    print("done")
except CalibrationError as error:
    print(error)
"""


@pytest.mark.parametrize("free", [14, 20])
def test_workers_end_where_not_all_can_be_started(free: int) -> None:
    code = _FEW_FILES.replace("{free}", str(free))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100, check=False)
    assert "processes cannot be started (Too many open files)" in done.stdout


_WAITING = """
import os, sys, time
from calgraph.parallel.engine import Processes
print(os.getpid(), flush=True)
list(Processes(3).map(time.sleep, [(600,)] * 3))
"""


def test_workers_end_with_a_parent_that_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _WAITING], stdout=subprocess.PIPE, start_new_session=True
    ) as parent:
        assert parent.stdout is not None
        parent.stdout.readline()
        time.sleep(1)
        parent.kill()
        # The workers hold the other end of the pipe.
        assert parent.stdout.read() == b""


_STOPPED_BETWEEN_WORKERS = """
import os, signal, sys, time
from calgraph.parallel.engine import Processes
{handler}
forks = []
def stop_before_second(event, _arguments):
    if event == "os.fork":
        forks.append(event)
        if len(forks) == 2:
            os.kill(os.getpid(), signal.{name})
sys.addaudithook(stop_before_second)
# A second worker starts only while the first one is busy.
list(Processes(2).map(time.sleep, [(5,), (5,)]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("handled", ["by the program", "by calgraph"])
def test_a_signal_between_the_starts_of_two_workers_ends_the_program(name: str, handled: str) -> None:
    number = f"signal.{name}"
    handler, expected = f"signal.signal({number}, lambda *_: sys.exit(3))", 3
    if handled == "by calgraph":
        # Background jobs of shells ignore SIGINT.
        handler = (
            f"import calgraph.io.termination as one; signal.signal({number}, signal.SIG_DFL); one.handle_signals()"
        )
        expected = 128 + getattr(signal, name)
    code = _STOPPED_BETWEEN_WORKERS.replace("{name}", name).replace("{handler}", handler)
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == expected


_STOPPED_BY_A_WORKER = """
import os, signal, time
from calgraph.parallel.engine import Processes
from calgraph.io.termination import handle_signals
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
handle_signals()
def stop_program(seconds):
    os.kill(os.getppid(), signal.{name})
    time.sleep(seconds)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    "call", ["Processes(3).map(stop_program, [(600,)] * 9)", "Processes(3).map(stop_program, iter([(600,)] * 9))"]
)
def test_a_signal_does_not_wait_for_calls_that_workers_carry_out(name: str, call: str) -> None:
    code = _STOPPED_BY_A_WORKER.replace("{name}", name) + f"list({call})"
    # The end of its output is that of all its processes.
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + getattr(signal, name), "", "")


def test_a_worker_pool_runs_before_its_first_call() -> None:
    with worker_pool(2) as pool:
        workers = {worker.pid for worker in multiprocessing.active_children()}
        assert len(workers) == 2
        assert pool.submit(os.getpid).result() in workers
    assert multiprocessing.active_children() == []


def write_half_a_result() -> None:
    """Does what a worker that is killed while it returns a result has done until then."""
    frame: FrameType | None = sys._getframe()
    while frame and "result_queue" not in frame.f_locals:
        frame = frame.f_back
    assert frame
    os.write(frame.f_locals["result_queue"]._writer.fileno(), struct.pack("!i", 1000) + b"half")
    time.sleep(600)


@pytest.mark.timeout(60)
def test_a_worker_pool_ends_while_a_result_is_being_written() -> None:
    with worker_pool(1) as pool:
        pool.submit(write_half_a_result)
        time.sleep(0.2)


def test_a_worker_pool_does_not_wait_for_calls_under_way() -> None:
    began = time.monotonic()
    with worker_pool(1) as pool:
        pool.submit(time.sleep, 600.0)
    assert time.monotonic() - began < 300
    assert multiprocessing.active_children() == []

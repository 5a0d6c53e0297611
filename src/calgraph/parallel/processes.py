"""Processes of this machine: how many, how they start and end, and pools of them for live capture."""

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from typing import Literal

from calgraph.errors import CalibrationError, WorkerKilledError
from calgraph.io.termination import SIGNALS, add_cleanup, remove_cleanup

KILLED_MESSAGE = "a process was killed, perhaps because memory ran out; reduce `jobs`"
"""The message of the error."""
# A forked worker has all imports and needs no importable main module, which a notebook does not have. NumPy
# supports forking, and no thread of calgraph holds a lock then, which is what Python 3.12 warns about.
START_METHOD: Literal["fork", "spawn"] = "fork" if sys.platform == "linux" else "spawn"
"""Of worker processes."""


def available_cores() -> int:
    """The processors that this process may use."""
    # A container or a batch system may grant fewer than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def forked_jobs(jobs: int) -> int:
    """The number of processes for work of less than a second: 1 where each process imports everything again."""
    return jobs if START_METHOD == "fork" else 1


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes for calls whose results are not waited for, of a program that serves while they work.

    They run when the block begins: no process is forked once the program has threads. When the block ends, waiting
    calls are cancelled, and those under way are ended.

    Args:
        workers: number of processes.

    Raises:
        CalibrationError: processes cannot be started.
    """
    context = multiprocessing.get_context(START_METHOD)
    try:
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=start_worker)
    except (OSError, ImportError, NotImplementedError) as error:
        # Semaphores are in shared memory, which containers may lack.
        raise CalibrationError("several processes are not possible here, and live capture needs them") from error
    # Calls may take minutes, which a signal does not wait for.
    add_cleanup(pool, partial(_kill_workers, pool))
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
            _start_all(pool)
            yield pool
    finally:
        _kill_workers(pool)
        with suppress(RuntimeError):  # from a thread of the executor that could not be started
            pool.shutdown(wait=True, cancel_futures=True)
        remove_cleanup(pool)


def _start_all(pool: ProcessPoolExecutor) -> None:
    try:
        with postponed_signals():
            started = pool.submit(os.getpid)
        started.result()
    except BrokenProcessPool as error:
        raise WorkerKilledError(KILLED_MESSAGE) from error
    except (OSError, RuntimeError) as error:
        # The latter is how threads fail to start.
        reason = getattr(error, "strerror", None) or error
        raise CalibrationError(f"processes cannot be started ({reason}); reduce `jobs`") from error


@contextmanager
def postponed_signals() -> Iterator[None]:
    """Handles signals that end the program after the block.

    An exception from their handlers between the starts of two workers would leave the first one running: the
    executor does not end it, and the interpreter waits for it.
    """
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    # Only the main thread handles signals; a handler that is not Python's cannot be set again.
    if threading.current_thread() is not threading.main_thread() or None in handlers.values():
        yield
        return
    received: list[int] = []
    try:
        for number in SIGNALS:
            signal.signal(number, lambda number, _frame: received.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for postponed in received:
            signal.raise_signal(postponed)


def _kill_workers(pool: ProcessPoolExecutor) -> None:
    """Ends the workers of a pool, and waits for their end.

    They may still have the handlers of this process, which postpone SIGTERM.
    """
    workers = list((getattr(pool, "_processes", None) or {}).values())
    for worker in workers:
        worker.kill()
    for worker in workers:
        worker.join()
    # A thread of the pool may wait for the rest of a result that was being written: only this process's own end of
    # the pipe keeps it from the end of the file.
    if results := getattr(pool, "_result_queue", None):
        results._writer.close()


def start_worker() -> None:
    """Ignores signals of terminals, and ends with the parent.

    A terminal sends SIGINT and SIGHUP to all processes, and the parent handles them. A parent that is killed does
    not end its workers, which would wait for work for ever.
    """
    try:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    except RuntimeError:  # too little memory, or too many threads; the parent reports a killed process
        os._exit(1)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.SIG_IGN)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

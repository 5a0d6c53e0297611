"""Parallel evaluation in several processes of this machine."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Literal, TypeVar

from calgraph.errors import CalibrationError, WorkerKilledError
from calgraph.io.termination import SIGNALS, add_cleanup, remove_cleanup

_log = logging.getLogger(__name__)

Result = TypeVar("Result")

# Calls of a stream that are submitted ahead for each process: enough that short calls behind a long one keep all
# processes busy, few enough that their arguments fit into memory.
_SUBMITTED_PER_PROCESS = 4
KILLED_MESSAGE = "a process was killed, perhaps because memory ran out; reduce `jobs`"
"""The message of the error."""
# A forked worker has all imports and needs no importable main module, which a notebook does not have. NumPy
# supports forking, and no thread of calgraph holds a lock then, which is what Python 3.12 warns about.
START_METHOD: Literal["fork", "spawn"] = "fork" if sys.platform == "linux" else "spawn"
"""Of worker processes."""
_shared: list[Any] = []
"""In a worker: the one argument that all calls of its pool share."""


def available_cores() -> int:
    """The processors that this process may use."""
    # A container or a batch system may grant fewer than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def forked_jobs(jobs: int) -> int:
    """The number of processes for work of less than a second: 1 where each process imports everything again."""
    return jobs if START_METHOD == "fork" else 1


def parallel_map(
    function: Callable[..., Result],
    work: Sequence[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[float], None] = lambda _done: None,
) -> list[Result]:
    """Calls a function once per tuple of arguments, in up to ``jobs`` processes; returns results in order.

    Several processes require a program that may be forked (Linux), or whose main module can be imported again
    (elsewhere), and shared memory for semaphores: where the system gives none, all calls run in this process.

    Args:
        function: defined at module level; its results are pickled, its arguments only where processes are not
            forked.
        work: arguments of each call.
        jobs: maximum number of processes; with 1 all calls run in this process.
        progress: called with the completed fraction, 0..1.

    Raises:
        WorkerKilledError: a process was killed.
        CalibrationError: processes cannot be started; or what ``function`` raises.
    """
    forked = START_METHOD == "fork"
    with _process_pool(min(jobs, len(work)), (function, work) if forked else None) as pool:
        if pool is None:
            results = []
            for done, arguments in enumerate(work, start=1):
                results.append(function(*arguments))
                progress(done / len(work))
            return results
        if forked:
            futures = [_submit(pool, _call_with_shared, _call_nth, (n,)) for n in range(len(work))]
        else:
            futures = [_submit(pool, function, *arguments) for arguments in work]
        for done, future in enumerate(as_completed(futures), start=1):
            _get_result(future)
            progress(done / len(work))
    return [future.result() for future in futures]


def parallel_stream(
    function: Callable[..., Result], work: Iterable[tuple[Any, ...]], shared: Any, jobs: int
) -> Iterator[Result]:
    """Calls a function once per tuple of arguments of a stream, in up to ``jobs`` processes.

    The stream is read by this process while fewer than four calls per process are unfinished.

    Args:
        function: defined at module level; called with ``shared`` and the arguments. Arguments and results are
            pickled.
        work: arguments of each call.
        shared: first argument of all calls; pickled once per process, and not at all where processes are forked.
        jobs: maximum number of processes; with 1 all calls run in this process.

    Yields:
        Results in the order of the work, before an error: that of the first call that fails, else of the stream.

    Raises:
        WorkerKilledError: a process was killed.
        CalibrationError: processes cannot be started; or what ``function`` or the stream raises.
    """
    with _process_pool(jobs, shared) as pool:
        if pool is None:
            for arguments in work:
                yield function(shared, *arguments)
            return
        submitted: deque[Future[Result]] = deque()
        unfinished: set[Future[Result]] = set()
        for future in _submit_all(pool, function, work):
            submitted.append(future)
            unfinished.add(future)
            if len(unfinished) >= _SUBMITTED_PER_PROCESS * jobs:
                # Not for the oldest one, which may take longer than all the others.
                unfinished = wait(unfinished, return_when=FIRST_COMPLETED).not_done
            while submitted and submitted[0].done():
                yield _get_result(submitted.popleft())
        while submitted:
            yield _get_result(submitted.popleft())


@contextmanager
def parallel_call(
    function: Callable[..., Result], arguments: tuple[Any, ...], jobs: int
) -> Iterator[Callable[[], Result]]:
    """Calls a function in another process while the block runs.

    Args:
        function: defined at module level; its result is pickled.
        arguments: of the call; pickled only where processes are not forked.
        jobs: maximum number of processes; with 1 the function is called in this one, where the result is wanted.

    Yields:
        A function that waits for the result and returns it.

    Raises:
        WorkerKilledError: a process was killed.
        CalibrationError: processes cannot be started; or what ``function`` raises.
    """
    with _process_pool(min(jobs, 2), (function, arguments), workers=1) as pool:
        if pool is None:
            yield partial(function, *arguments)
        else:
            future: Future[Result] = _submit(pool, _call_with_shared, _call, ())
            yield partial(_get_result, future)


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
    with _process_pool(max(workers, 2), workers=workers) as pool:
        if pool is None:
            raise CalibrationError("several processes are not possible here, and live capture needs them")
        _get_result(_submit(pool, os.getpid))
        try:
            yield pool
        finally:
            _kill_workers(pool)


def _call(shared: tuple[Callable[..., Result], tuple[Any, ...]]) -> Result:
    function, arguments = shared
    return function(*arguments)


def _call_nth(shared: tuple[Callable[..., Result], Sequence[tuple[Any, ...]]], n: int) -> Result:
    function, work = shared
    return function(*work[n])


def _submit_all(
    pool: ProcessPoolExecutor, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]
) -> Iterator[Future[Result]]:
    """The futures of all calls; an error of the stream is the last one, so that earlier results come before it."""
    try:
        for arguments in work:
            yield _submit(pool, _call_with_shared, function, arguments)
    except Exception as error:
        failed: Future[Result] = Future()
        failed.set_exception(error)
        yield failed


def _submit(pool: ProcessPoolExecutor, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    try:
        with postponed_signals():
            return pool.submit(function, *arguments)
    except BrokenProcessPool as error:
        raise WorkerKilledError(KILLED_MESSAGE) from error
    except (OSError, RuntimeError) as error:
        # The latter is how threads fail to start. The executor leaves workers that were started before; the
        # interpreter would wait for them.
        _kill_workers(pool)
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


def _call_with_shared(function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result:
    return function(*_shared, *arguments)


def _get_result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise WorkerKilledError(KILLED_MESSAGE) from error


@contextmanager
def _process_pool(
    count: int, shared: object = None, workers: int | None = None
) -> Iterator[ProcessPoolExecutor | None]:
    """A pool of processes that is shut down when the block ends; pending work is cancelled if the block fails.

    None where one process is sufficient, or several are not possible.

    Args:
        count: of processes that are to work.
        shared: see :func:`start_worker`.
        workers: of which these are in the pool; all if left out, and this process waits.
    """
    pool = _make_pool(workers or count, shared) if count > 1 else None
    if pool is None:
        yield None
        return
    # Calls may take minutes, which a signal does not wait for.
    add_cleanup(pool, partial(_kill_workers, pool))
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
            yield pool
    finally:
        with suppress(RuntimeError):  # from a thread of the executor that could not be started
            pool.shutdown(wait=True, cancel_futures=True)
        remove_cleanup(pool)


def _make_pool(count: int, shared: object) -> ProcessPoolExecutor | None:
    context = multiprocessing.get_context(START_METHOD)
    try:
        return ProcessPoolExecutor(count, mp_context=context, initializer=start_worker, initargs=(shared,))
    except (OSError, ImportError, NotImplementedError) as error:
        # Semaphores are in shared memory, which containers may lack.
        reason = getattr(error, "strerror", None) or error
        _log.warning("several processes are not possible here (%s): one does the work", reason)
        return None


def start_worker(shared: object) -> None:
    """Keeps what the calls share, ignores signals of terminals, and ends with the parent.

    A terminal sends SIGINT and SIGHUP to all processes, and the parent handles them. A parent that is killed does
    not end its workers, which would wait for work for ever.
    """
    _shared[:] = [shared]
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

"""Parallel evaluation in several processes of this machine."""

import multiprocessing
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from calgraph.errors import CalibrationError

Result = TypeVar("Result")


def parallel_map(
    function: Callable[..., Result],
    work: Sequence[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[float], None] = lambda _done: None,
) -> list[Result]:
    """Calls a function once per tuple of arguments, in up to ``jobs`` processes; returns results in order.

    Several processes require a program that may be forked (Linux), or whose main module can be imported again
    (elsewhere).

    Args:
        function: defined at module level; its arguments and results are pickled.
        work: arguments of each call.
        jobs: maximum number of processes; with 1 all calls run in this process.
        progress: called with the completed fraction, 0..1.

    Raises:
        CalibrationError: a process was killed; or what ``function`` raises.
    """
    jobs = min(jobs, len(work))
    if jobs <= 1:
        results = []
        for done, arguments in enumerate(work, start=1):
            results.append(function(*arguments))
            progress(done / len(work))
        return results
    with _process_pool(jobs) as pool:
        futures = [pool.submit(function, *arguments) for arguments in work]
        for done, future in enumerate(as_completed(futures), start=1):
            _get_result(future)
            progress(done / len(work))
    return [future.result() for future in futures]


def _get_result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise CalibrationError("a process was killed, perhaps because memory ran out; reduce `jobs`") from error


@contextmanager
def _process_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes that is shut down when the block ends; pending work is cancelled if the block fails."""
    # A forked worker has all imports and needs no importable main module, which a notebook does not have. NumPy
    # supports forking, and no thread of calgraph holds a lock then, which is what Python 3.12 warns about.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_ignore_interrupts)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
            yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ignore_interrupts() -> None:
    """Ignores SIGINT in workers: a terminal sends it to all processes, and the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

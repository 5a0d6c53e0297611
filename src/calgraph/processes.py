"""Work shared by several processes of this machine."""

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


def side_by_side(
    function: Callable[..., Result],
    work: Sequence[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[float], None] = lambda _done: None,
) -> list[Result]:
    """Calls a function with each of many arguments, in as many processes at most; the results in their order.

    More processes than one are for programs that may be forked (Linux), or whose main module may be imported again
    (elsewhere).

    Args:
        function: of a module; what it is given and returns is copied from process to process.
        work: its arguments, call by call.
        jobs: processes at most; 1 for none but this one.
        progress: told how much is done, 0..1.

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
    with _workers(jobs) as pool:
        futures = [pool.submit(function, *arguments) for arguments in work]
        for done, future in enumerate(as_completed(futures), start=1):
            _result(future)
            progress(done / len(work))
    return [future.result() for future in futures]


def _result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise CalibrationError("a process was killed, perhaps for want of memory; try --jobs 1") from error


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with the block; if it fails, with what they are at."""
    # Forked, a worker has everything imported, and needs no main module: there is none in a notebook. NumPy
    # survives it, and no thread of ours holds a lock meanwhile, which is what Python 3.12 warns of.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_heed_no_signals)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
            yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _heed_no_signals() -> None:
    """Leaves an interruption, which all processes of a terminal hear of, to the one that started this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

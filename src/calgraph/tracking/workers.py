"""Many scanners followed side by side, by as many processes as there are to be."""

import multiprocessing
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from calgraph.errors import CalibrationError
from calgraph.rig import Cylinder, People, RangeNoise
from calgraph.tracking.features import Feature
from calgraph.tracking.scanner import track_runs
from calgraph.tracking.scans import ScanRun
from calgraph.tracking.track import Tracked, Untracked

# Fewer beams than these are followed before other processes have begun.
_WORTHWHILE = 500_000


def track_scanners(
    scans: Mapping[str, Sequence[ScanRun]],
    target: People | Cylinder,
    noise: Mapping[str, RangeNoise],
    *,
    feature: Feature = "nls",
    jobs: int = 1,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[str, Tracked | Untracked]:
    """Follows what moves through the view of each scanner, as :func:`calgraph.tracking.track_scanner` does.

    The result does not depend on the number of processes.

    Args:
        scans: by scanner.
        target: what moves.
        noise: by scanner.
        feature: how centres are measured.
        jobs: processes at most. More than one are for programs that may be forked (Linux), or whose main module
            may be imported again (elsewhere).
        progress: told how much is done, 0..1.

    Raises:
        CalibrationError: a process was killed.
    """
    work = {name: (runs, target, noise[name], feature) for name, runs in scans.items()}
    found: dict[str, Tracked | Untracked] = {}
    jobs = min(jobs, len(work)) if _beams(scans) > _WORTHWHILE else 1
    if jobs <= 1:
        for name, arguments in work.items():
            found[name] = track_runs(*arguments)
            progress(len(found) / len(work))
        return found
    with _workers(jobs) as pool:
        names: dict[Future[Tracked | Untracked], str] = {
            pool.submit(track_runs, *arguments): name for name, arguments in work.items()
        }
        for future in as_completed(names):
            found[names[future]] = _result(future)
            progress(len(found) / len(work))
    return {name: found[name] for name in work}


def _beams(scans: Mapping[str, Sequence[ScanRun]]) -> int:
    return sum(run.ranges.size for runs in scans.values() for run in runs)


def _result(future: Future[Tracked | Untracked]) -> Tracked | Untracked:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise CalibrationError(
            "a process that followed people was killed, perhaps for want of memory; try --jobs 1"
        ) from error


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

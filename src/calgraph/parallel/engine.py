"""Where the calls of a calibration run: in processes of this machine, or on a cluster."""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from calgraph.parallel.kept_values import Kept, call_with_values
from calgraph.parallel.mapped_arrays import ArrayMemory
from calgraph.parallel.processes import forked_jobs
from calgraph.parallel.worker_processes import start_workers

Result = TypeVar("Result")


class MapEngine(Protocol):
    """Evaluates independent calls. Results do not depend on where, nor on how many run at a time.

    What several calls take, and what calls leave for later ones, is a :class:`Kept` value.
    """

    @property
    def workers(self) -> int:
        """Calls of the engine that may run at the same time."""

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """Calls a function once per tuple of arguments; the work is read while calls run.

        Args:
            function: defined at module level; a call may be repeated, on another machine.
            work: arguments of each call, which are pickled unless the call is in this process.

        Yields:
            Results in the order of the work, before an error: that of the first call that fails, else of the
            work.

        Raises:
            WorkerKilledError: the process of a call was killed, also when it was repeated.
            CalibrationError: the engine cannot go on; or what ``function`` or the work raises.
        """


class Engine(MapEngine, Protocol):
    """Evaluates independent calls, and has workers that stay."""

    @property
    def jobs(self) -> int:
        """Processes of this machine that may work at the same time, for calls that the engine does not run."""

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
        """Workers for maps that follow each other: kept values stay until the block ends, not until a map ends.

        Args:
            max_kept_bytes: of arrays that each process of this machine keeps in memory for calls; further ones are
                in temporary files.
        """


@dataclass(frozen=True)
class Processes:
    """Processes of this machine, see :mod:`worker_processes`; all calls run in this one if there is one only."""

    jobs: int = 1

    @property
    def workers(self) -> int:
        """See :attr:`MapEngine.workers`."""
        return self.jobs

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """See :meth:`MapEngine.map`."""
        jobs = min(self.jobs, len(work)) if isinstance(work, Sequence) else self.jobs
        with _open_workers(jobs) as workers:
            yield from workers.map(function, work)

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
        """See :meth:`Engine.keep_workers`."""
        # Elsewhere, each would import everything again.
        return _open_workers(forked_jobs(self.jobs), max_kept_bytes)


THIS_PROCESS = Processes()
"""No other process."""


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
        WorkerKilledError: the process was killed, also when the call was repeated.
        CalibrationError: processes cannot be started; or what ``function`` raises.
    """
    if jobs < 2:
        yield partial(function, *arguments)
        return
    with start_workers(1) as workers:
        yield workers.start(function, *(Kept.of(argument) for argument in arguments))


class _ThisProcess:
    """This process alone, with limited memory for values; see :class:`MapEngine`."""

    workers = 1

    def __init__(self, memory: ArrayMemory) -> None:
        self._memory = memory

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """See :meth:`MapEngine.map`."""
        for arguments in work:
            yield call_with_values(function, arguments, self._memory)


def _open_workers(jobs: int, *max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
    # Workers have none.
    if jobs > 1 and not multiprocessing.current_process().daemon:
        return start_workers(jobs, *max_kept_bytes)
    return nullcontext(_ThisProcess(ArrayMemory(*max_kept_bytes)))

"""Where the calls of a calibration run: in processes of this machine, or on a cluster."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from calgraph.parallel.mapped_arrays import ArrayMemory, KeptValue
from calgraph.parallel.processes import forked_jobs, parallel_map, parallel_stream
from calgraph.parallel.worker_processes import start_workers

Result = TypeVar("Result")


class MapEngine(Protocol):
    """Evaluates lists of independent calls. Results do not depend on where, nor on how many run at a time.

    Values that several calls take are made available once. A handle then stands for each of them among the
    arguments of calls, not within other arguments, and the call gets the value. A value is available as long as
    its handle exists.
    """

    @property
    def workers(self) -> int:
        """Calls of the engine that may run at the same time."""

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        """Calls a function once per tuple of arguments.

        Args:
            function: defined at module level; a call may be repeated, on another machine.
            work: arguments of each call.
            progress: called with the completed fraction, 0..1.

        Returns:
            Results in the order of the work.

        Raises:
            CalibrationError: the engine cannot go on; or what ``function`` raises.
        """

    def put(self, values: Sequence[Any]) -> list[Any]:
        """Makes values available to calls.

        Returns:
            The handle of each.
        """

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        """Calls a function that returns a result and a value for later calls, which stays where it is.

        Args:
            function: as for :meth:`map`; returns the result and the value.
            work: arguments of each call.

        Returns:
            Results in the order of the work, and handles of the values.

        Raises:
            CalibrationError: the engine cannot go on; or what ``function`` raises.
        """


class Engine(MapEngine, Protocol):
    """Evaluates independent calls, also those of a stream."""

    @property
    def jobs(self) -> int:
        """Processes of this machine that may work at the same time, for calls that the engine does not run."""

    def stream(
        self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]], shared: Any
    ) -> Iterator[Result]:
        """Calls a function once per tuple of arguments of a stream, which is read while calls run.

        Args:
            function: as for :meth:`map`; called with ``shared`` and the arguments.
            work: arguments of each call.
            shared: first argument of all calls.

        Yields:
            Results in the order of the work, before an error: that of the first call that fails, else of the
            stream.

        Raises:
            CalibrationError: the engine cannot go on; or what ``function`` or the stream raises.
        """

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
        """Workers for maps that follow each other: until the block ends, they keep values without sending them.

        Args:
            max_kept_bytes: of arrays that each process of this machine keeps in memory for calls; further ones are
                in temporary files.
        """


@dataclass(frozen=True)
class Processes:
    """Processes of this machine, see :mod:`processes`; all calls run in this one if there is one only.

    Handles are the values themselves: a forked process has those of this one.
    """

    jobs: int = 1

    @property
    def workers(self) -> int:
        """See :attr:`Engine.workers`."""
        return self.jobs

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        """See :meth:`Engine.map`."""
        return parallel_map(function, work, self.jobs, progress)

    def put(self, values: Sequence[Any]) -> list[Any]:
        """See :meth:`Engine.put`."""
        return list(values)

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        """See :meth:`Engine.map_and_keep`."""
        pairs = self.map(function, work)
        return [result for result, _ in pairs], [value for _, value in pairs]

    def stream(
        self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]], shared: Any
    ) -> Iterator[Result]:
        """See :meth:`Engine.stream`."""
        return parallel_stream(function, work, shared, self.jobs)

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
        """See :meth:`Engine.keep_workers`."""
        # Elsewhere, each would import everything again.
        jobs = forked_jobs(self.jobs)
        return start_workers(jobs, max_kept_bytes) if jobs > 1 else nullcontext(_ThisProcess(max_kept_bytes))


class _ThisProcess:
    """This process alone, with limited memory for values; see :class:`MapEngine`."""

    workers = 1

    def __init__(self, max_kept_bytes: int) -> None:
        self._memory = ArrayMemory(max_kept_bytes)

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        """See :meth:`MapEngine.map`."""
        results = []
        for done, arguments in enumerate(work, start=1):
            results.append(function(*(self._load(argument) for argument in arguments)))
            progress(done / len(work))
        return results

    def put(self, values: Sequence[Any]) -> list[Any]:
        """See :meth:`MapEngine.put`."""
        return [self._memory.keep(value) for value in values]

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        """See :meth:`MapEngine.map_and_keep`."""
        results, handles = [], []
        for arguments in work:
            result, value = function(*(self._load(argument) for argument in arguments))
            results.append(result)
            handles.append(self._memory.keep(value))
        return results, handles

    @staticmethod
    def _load(argument: Any) -> Any:
        return argument.load() if isinstance(argument, KeptValue) else argument


THIS_PROCESS = Processes()
"""No other process."""

"""Processes of this machine that stay, and keep values between calls.

Calls are sent through pipes by the thread that waits for their results, one at a time to each process: no process
is forked while the program has other threads, and a process is never sent a call while it sends a result.
"""

import multiprocessing
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkContext
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple, TypeVar
from weakref import finalize

from calgraph.errors import CalibrationError, WorkerKilledError
from calgraph.io.termination import add_cleanup, remove_cleanup
from calgraph.parallel.mapped_arrays import ArrayMemory, KeptValue
from calgraph.parallel.processes import KILLED_MESSAGE, postponed_signals, start_worker

Result = TypeVar("Result")


class _Placeholder(NamedTuple):
    """Stands for a value among the arguments of a call in a process."""

    number: int


class _Request(NamedTuple):
    """What a process is sent."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    """With placeholders."""
    values: dict[int, Any]
    """Those that the process has not been sent yet, by their numbers."""
    released: list[int]
    """Numbers of values that no call takes any more."""
    keep: int | None
    """The number of the second part of the result; None where all of it is sent back."""


@dataclass(eq=False)
class _Worker:
    """A process as this one knows it."""

    process: BaseProcess
    connection: Connection
    released: list[int] = field(default_factory=list)
    """Numbers of values to release, to be sent with the next call."""


@dataclass(eq=False)
class _Handle:
    """Stands for a value among the arguments of a map."""

    number: int
    holders: list[_Worker]
    """Processes that have the value."""
    value: tuple[Any, ...] = ()
    """The value, where this process has it as well."""


class WorkerProcesses:
    """A :class:`calgraph.parallel.engine.MapEngine` of processes that stay.

    A call runs where the values of its handles are; other calls run in the next free process.

    Args:
        workers: that have been started.
    """

    def __init__(self, workers: Sequence[_Worker]) -> None:
        self._workers, self._numbers = workers, count()

    @property
    def workers(self) -> int:
        """See :attr:`calgraph.parallel.engine.MapEngine.workers`."""
        return len(self._workers)

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        """See :meth:`calgraph.parallel.engine.MapEngine.map`."""
        return self._run(function, work, [None] * len(work), progress)

    def put(self, values: Sequence[Any]) -> list[Any]:
        """See :meth:`MapEngine.put`; processes are sent values with calls that take them."""
        return [self._make_handle(value) for value in values]

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        """See :meth:`calgraph.parallel.engine.MapEngine.map_and_keep`."""
        handles = [self._make_handle() for _ in work]
        return self._run(function, work, handles), handles

    def _make_handle(self, *value: Any) -> _Handle:
        handle = _Handle(next(self._numbers), [], value)
        finalize(handle, _release, handle.number, handle.holders)
        return handle

    def _run(
        self,
        function: Callable[..., Any],
        work: Sequence[tuple[Any, ...]],
        kept: Sequence[_Handle | None],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Any]:
        """Calls the function for each tuple of arguments; a handle is of what the call keeps."""
        results: list[Any] = [None] * len(work)
        bound: dict[_Worker, deque[int]] = {worker: deque() for worker in self._workers}
        free: deque[int] = deque()
        for n, arguments in enumerate(work):
            holder = self._find_holder(arguments)
            (free if holder is None else bound[holder]).append(n)
        working: dict[Any, tuple[_Worker, int]] = {}
        idle, done, failure = list(self._workers), 0, None
        while True:
            for worker in idle if failure is None else ():
                if waiting := bound[worker] or free:
                    n = waiting.popleft()
                    self._send(worker, function, work[n], kept[n])
                    working[worker.connection] = worker, n
            if not working:
                break
            idle = []
            for connection in wait(list(working)):
                worker, n = working.pop(connection)
                idle.append(worker)
                succeeded, results[n] = _receive(worker)
                if not succeeded:
                    failure = failure or results[n]
                elif handle := kept[n]:
                    handle.holders.append(worker)
                done += 1
                progress(done / len(work))
        if failure is not None:
            raise failure
        return results

    def _find_holder(self, arguments: Sequence[Any]) -> _Worker | None:
        """The process that has to do a call, since it has values, if there is only one.

        Values that are kept in different processes are made available to all.
        """
        handles = [argument for argument in arguments if isinstance(argument, _Handle) and argument.holders]
        common = [worker for worker in self._workers if all(worker in handle.holders for handle in handles)]
        if not common:
            for handle in handles:
                handle.value = handle.value or (self._fetch(handle),)
        return common[0] if len(common) == 1 else None

    def _fetch(self, handle: _Handle) -> Any:
        self._send(handle.holders[0], _return, (handle,), None)
        _, value = _receive(handle.holders[0])
        return value

    def _send(
        self, worker: _Worker, function: Callable[..., Any], arguments: Sequence[Any], keep: _Handle | None
    ) -> None:
        new = {
            argument.number: argument
            for argument in arguments
            if isinstance(argument, _Handle) and worker not in argument.holders
        }
        request = _Request(
            function,
            tuple(
                _Placeholder(argument.number) if isinstance(argument, _Handle) else argument
                for argument in arguments
            ),
            {number: handle.value[0] for number, handle in new.items()},
            worker.released.copy(),
            keep.number if keep else None,
        )
        content = ForkingPickler.dumps(request)
        for handle in new.values():
            handle.holders.append(worker)
        worker.released.clear()
        try:
            worker.connection.send_bytes(content)
        except OSError as error:
            raise WorkerKilledError(KILLED_MESSAGE) from error


@contextmanager
def start_workers(workers: int, max_kept_bytes: int) -> Iterator[WorkerProcesses]:
    """Processes that end with the block, where processes can be forked.

    Args:
        workers: their number.
        max_kept_bytes: of arrays that each of them keeps in memory; further ones are in temporary files.

    Raises:
        CalibrationError: processes cannot be started.
    """
    context = multiprocessing.get_context("fork")
    started: list[_Worker] = []
    key = object()
    # Calls may take minutes, which a signal does not wait for.
    add_cleanup(key, partial(_kill, started))
    try:
        try:
            for _ in range(workers):
                with postponed_signals(), warnings.catch_warnings():
                    warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
                    started.append(_start(context, max_kept_bytes))
        except OSError as error:
            reason = error.strerror or error
            raise CalibrationError(f"processes cannot be started ({reason}); reduce `jobs`") from error
        yield WorkerProcesses(started)
    finally:
        _kill(started)
        remove_cleanup(key)


def _start(context: ForkContext, max_kept_bytes: int) -> _Worker:
    ours, its = context.Pipe()
    process = context.Process(target=_serve, args=(its, max_kept_bytes), daemon=True)
    process.start()
    # The last copy is the process's own: its end is the end of what can be received.
    its.close()
    return _Worker(process, ours)


def _kill(workers: Sequence[_Worker]) -> None:
    for worker in workers:
        worker.process.kill()
    for worker in workers:
        worker.process.join()
        worker.connection.close()


def _receive(worker: _Worker) -> tuple[bool, Any]:
    """Whether a call succeeded, and its result or error."""
    try:
        succeeded, result = worker.connection.recv()
    except (EOFError, OSError) as error:
        raise WorkerKilledError(KILLED_MESSAGE) from error
    return succeeded, result


def _release(number: int, holders: Sequence[_Worker]) -> None:
    for worker in holders:
        worker.released.append(number)


def _serve(connection: Connection, max_kept_bytes: int) -> None:
    """Answers requests for as long as the process runs."""
    start_worker(None)
    memory, values = ArrayMemory(max_kept_bytes), dict[int, KeptValue]()
    while True:
        request: _Request = connection.recv()
        try:
            content = ForkingPickler.dumps((True, _answer(request, values, memory)))
        except Exception as error:
            error.add_note(traceback.format_exc())
            content = ForkingPickler.dumps((False, error))
        connection.send_bytes(content)


def _answer(request: _Request, values: dict[int, KeptValue], memory: ArrayMemory) -> Any:
    """The result of a call; changes the values that the process keeps."""
    for number in request.released:
        values.pop(number, None)
    values.update((number, memory.keep(value)) for number, value in request.values.items())
    result = request.function(
        *(
            values[argument.number].load() if isinstance(argument, _Placeholder) else argument
            for argument in request.arguments
        )
    )
    if request.keep is None:
        return result
    result, kept = result
    values[request.keep] = memory.keep(kept)
    return result


def _return(value: Result) -> Result:
    return value

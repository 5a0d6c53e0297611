"""Processes of this machine that calls are sent to.

Calls are sent through pipes by the thread that waits for their results, one at a time to each process: no process
is forked while the program has other threads, and a process is never sent a call while it sends a result.
"""

import io
import math
import multiprocessing
import pickle
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from calgraph.errors import CalgraphError, CalibrationError, WorkerKilledError
from calgraph.io.termination import add_cleanup, remove_cleanup
from calgraph.parallel.kept_values import Kept, call_with_values, existing
from calgraph.parallel.mapped_arrays import ArrayMemory
from calgraph.parallel.processes import KILLED_MESSAGE, START_METHOD, postponed_signals, start_worker

Result = TypeVar("Result")

# Calls that are read ahead for each process: enough that short calls behind a long one keep all processes busy,
# few enough that their arguments fit into memory.
_READ_PER_PROCESS = 4
# Processes that a call may lose: one may have been killed because of the memory of others, so that the call is
# repeated while no other one runs.
_MAX_LOST = 1


class WorkerProcesses:
    """A :class:`calgraph.parallel.engine.MapEngine` of processes, which are started when there are calls for them.

    A call runs where the values that it takes are kept; other calls run in the next free process.

    Args:
        workers: processes at most.
        max_kept_bytes: of arrays that each of them keeps in memory; further ones are in temporary files.
    """

    def __init__(self, workers: int, max_kept_bytes: float) -> None:
        self.workers = workers
        self._max_kept_bytes = max_kept_bytes
        self._started: list[_Worker] = []

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """See :meth:`calgraph.parallel.engine.MapEngine.map`."""
        for worker in self._started:
            worker.forget()
        places = self._list_places()
        source, calls, waiting = iter(work), deque[_Call](), deque[_Call]()
        unread = True
        while unread or calls:
            self._receive(0.0)
            self._send(waiting)
            busy = sum(worker.call is not None for worker in self._started)
            if calls and calls[0].outcome:
                yield calls.popleft().give()
            elif unread and len(waiting) + busy < _READ_PER_PROCESS * self.workers:
                try:
                    arguments = next(source)
                except StopIteration:
                    unread = False
                except Exception as error:
                    # Earlier results come before it.
                    calls.append(_Call(function, (), waiting, outcome=(False, error)))
                    unread = False
                else:
                    calls.append(_Call(function, arguments, waiting, _find_home(arguments, places)))
                    waiting.append(calls[-1])
            elif calls:
                self._receive(None)

    def start(self, function: Callable[..., Result], *arguments: Any) -> Callable[[], Result]:
        """Starts a call; returns a function that waits for its result and returns it."""
        waiting = deque[_Call]()
        call = _Call(function, arguments, waiting)
        waiting.append(call)
        self._send(waiting)
        return partial(self._finish, call)

    def end(self) -> None:
        """Ends all processes."""
        for worker in self._started:
            worker.process.kill()
        for worker in self._started:
            worker.end()

    def _finish(self, call: "_Call") -> Any:
        while call.outcome is None:
            self._send(call.waiting)
            self._receive(None)
        return call.give()

    def _list_places(self) -> dict[int, "_Worker | None"]:
        """The process that has a value, by the value's number; None if several have it."""
        places: dict[int, _Worker | None] = {}
        for worker in self._started:
            for number in worker.computed:
                places[number] = None if number in places else worker
        return places

    def _send(self, waiting: "deque[_Call]") -> None:
        """Sends those of the calls that a process without a call can do."""
        while waiting and (chosen := self._choose(waiting)):
            worker, call = chosen
            waiting.remove(call)
            worker.send(call)

    def _choose(self, waiting: "deque[_Call]") -> "tuple[_Worker, _Call] | None":
        idle = [worker for worker in self._started if worker.call is None]
        busy = [worker.call for worker in self._started if worker.call]
        if busy and (waiting[0].lost or any(call.lost for call in busy)):
            return None
        for call in waiting:
            if call.home in idle:
                return call.home, call
        free = next((call for call in waiting if call.home not in self._started), None)
        if free is None or len(busy) == self.workers:
            return None
        if not idle:
            # A signal before the process is among those to end would leave it running.
            with postponed_signals():
                self._started.append(_start_worker(self._max_kept_bytes))
        return idle[0] if idle else self._started[-1], free

    def _receive(self, timeout: float | None) -> None:
        """Takes the outcomes of calls; with no limit in time, that of one call at least."""
        busy: dict[Any, _Worker] = {worker.connection: worker for worker in self._started if worker.call}
        for connection in wait(list(busy), timeout) if busy else ():
            if not busy[connection].receive():
                self._started.remove(busy[connection])
                busy[connection].end()


@contextmanager
def start_workers(workers: int, max_kept_bytes: float = math.inf) -> Iterator[WorkerProcesses]:
    """Processes that end with the block; see :class:`WorkerProcesses`.

    Raises:
        CalibrationError: processes cannot be started.
    """
    processes = WorkerProcesses(workers, max_kept_bytes)
    # Calls may take minutes, which a signal does not wait for.
    add_cleanup(processes, processes.end)
    try:
        yield processes
    finally:
        processes.end()
        remove_cleanup(processes)


@dataclass(eq=False)
class _Call:
    """A call, and what has become of it."""

    function: Callable[..., Any]
    arguments: Sequence[Any]
    waiting: "deque[_Call]"
    """The calls to send next, to which it returns if its process is killed."""
    home: "_Worker | None" = None
    """The process that has to do it, since it has values; None if any may."""
    lost: int = 0
    """Processes that were killed with it."""
    outcome: tuple[bool, Any] | None = None
    """Whether it succeeded, and its result or error."""

    def give(self) -> Any:
        """The result, or raises the error."""
        assert self.outcome
        succeeded, result = self.outcome
        if not succeeded:
            raise result
        return result


@dataclass(eq=False)
class _Worker:
    """A process as this one knows it."""

    process: Any
    connection: Connection
    known: set[int]
    """Numbers of the values that it has or can compute."""
    computed: set[int] = field(default_factory=set)
    """Numbers of those that it has."""
    released: set[int] = field(default_factory=set)
    """Numbers of those that no call takes any more, to be sent with the next call."""
    call: _Call | None = None
    """Under way."""

    def forget(self) -> None:
        """Has the process release the values that no longer exist."""
        released = self.known - set(existing.keys())
        self.released |= released
        self.known -= released
        self.computed -= released

    def send(self, call: _Call) -> None:
        """Sends a call to the process, which has none."""
        content = io.BytesIO()
        pickler = _CallPickler(content, self.known)
        pickler.dump((call.function, call.arguments, self.released))
        self.call = call
        self.computed |= {kept.number for kept in _list_kept(call.arguments)}
        self.known |= pickler.sent
        self.released = set()
        with suppress(OSError):  # it was killed, which is found where its result is waited for
            self.connection.send_bytes(content.getbuffer())

    def receive(self) -> bool:
        """Takes the outcome of the call; False if the process was killed."""
        assert self.call
        call, self.call = self.call, None
        try:
            call.outcome = self.connection.recv()
        except (EOFError, OSError):
            call.lost += 1
            if call.lost > _MAX_LOST:
                call.outcome = False, WorkerKilledError(KILLED_MESSAGE)
            else:
                call.waiting.appendleft(call)
            return False
        return True

    def end(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def _start_worker(max_kept_bytes: float) -> _Worker:
    context: Any = multiprocessing.get_context(START_METHOD)
    inherited = {number: kept.recipe for number, kept in existing.items()} if START_METHOD == "fork" else {}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
            ours, its = context.Pipe()
            # Closes the process's end of the pipe here: its end is then the end of what can be received.
            with its:
                process = context.Process(target=_serve, args=(its, inherited, max_kept_bytes), daemon=True)
                process.start()
    except OSError as error:
        reason = error.strerror or error
        raise CalibrationError(f"processes cannot be started ({reason}); reduce `jobs`") from error
    return _Worker(process, ours, set(inherited))


def _find_home(arguments: Sequence[Any], places: Mapping[int, _Worker | None]) -> _Worker | None:
    """The process that has values of a call, if it is the only one."""
    homes = {places.get(kept.number) for kept in _list_kept(arguments)} - {None}
    return homes.pop() if len(homes) == 1 else None


def _list_kept(arguments: Sequence[Any]) -> Iterator[Kept]:
    """The kept values among arguments, and those that these are computed from."""
    for argument in arguments:
        if isinstance(argument, Kept):
            yield argument
            yield from _list_kept(argument.recipe[1])


class _CallPickler(pickle.Pickler):
    """Writes kept values as numbers, with their recipes if a process does not know them."""

    def __init__(self, content: io.BytesIO, known: set[int]) -> None:
        super().__init__(content, protocol=5)
        self._known, self.sent = known, set[int]()

    def persistent_id(self, value: Any) -> tuple[int, Any] | None:
        """What stands for a kept value; None for what is written as it is."""
        if not isinstance(value, Kept):
            return None
        known = value.number in self._known or value.number in self.sent
        self.sent.add(value.number)
        return value.number, None if known else value.recipe


class _CallUnpickler(pickle.Unpickler):
    """Reads what :class:`_CallPickler` has written, and adds to the kept values of this process."""

    def __init__(self, content: io.BytesIO, kept: dict[int, Kept]) -> None:
        super().__init__(content)
        self._kept = kept

    def persistent_load(self, identifier: tuple[int, Any]) -> Kept:
        """The kept value."""
        number, recipe = identifier
        if recipe is not None:
            function, arguments = recipe
            self._kept[number] = Kept(function, *arguments)
        return self._kept[number]


def _serve(connection: Connection, inherited: Mapping[int, Any], max_kept_bytes: float) -> None:
    """Answers calls for as long as the process runs."""
    start_worker()
    kept = {number: Kept(function, *arguments) for number, (function, arguments) in inherited.items()}
    memory = ArrayMemory(max_kept_bytes)
    while True:
        try:
            content = connection.recv_bytes()
        except EOFError:
            return
        try:
            answer = pickle.dumps((True, _answer(content, kept, memory)), protocol=5)
        except Exception as error:
            if not isinstance(error, CalgraphError):  # these state what was wrong
                error.add_note(traceback.format_exc())
            answer = pickle.dumps((False, error))
        connection.send_bytes(answer)


def _answer(content: bytes, kept: dict[int, Kept], memory: ArrayMemory) -> Any:
    """The result of a call; changes the values that the process keeps."""
    function, arguments, released = _CallUnpickler(io.BytesIO(content), kept).load()
    for number in released:
        del kept[number]
    return call_with_values(function, arguments, memory)

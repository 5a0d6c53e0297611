"""An engine whose calls run on the workers of a Dask cluster."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeVar

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, WorkerKilledError
from calgraph.parallel.engine import MapEngine

if TYPE_CHECKING:
    from distributed import Client, Future

Result = TypeVar("Result")

# Between two questions how many workers there are, s: each takes milliseconds, and workers take seconds to start.
_COUNT_INTERVAL = 1.0


class DaskEngine:
    """Calls on the workers of a cluster; see :class:`calgraph.parallel.engine.Engine`.

    A call of a worker that is lost is repeated on another one, and so are the calls whose results it had. Handles
    are futures, whose values are computed again in the same way: data that are put there are part of a task, and
    remain in the scheduler's memory.

    Args:
        client: connected.
        settings: of clusters.
    """

    jobs = 1
    """Threads of the client are running, and a process with threads should not be forked."""

    def __init__(self, client: "Client", settings: DaskSettings) -> None:
        self._client, self._settings = client, settings
        self._address = str(client.scheduler.address)

    @property
    def workers(self) -> int:
        """Workers that the cluster has now."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        """See :meth:`calgraph.parallel.engine.Engine.map`."""
        from distributed import as_completed

        with self._futures() as submitted:
            submitted += [self._submit(function, *arguments) for arguments in work]
            for done, future in enumerate(as_completed(submitted), start=1):
                if future.status == "error":
                    future.result()
                progress(done / len(submitted))
            return list(self._client.gather(list(submitted)))

    def put(self, values: Sequence[Any]) -> list[Any]:
        """See :meth:`calgraph.parallel.engine.Engine.put`."""
        with self._explained_errors():
            return [self._submit(_return, value) for value in values]

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        """See :meth:`calgraph.parallel.engine.Engine.map_and_keep`."""
        with self._explained_errors():
            both = [self._submit(function, *arguments) for arguments in work]
            kept = [self._submit(itemgetter(1), pair) for pair in both]
        return self.map(itemgetter(0), [(pair,) for pair in both]), kept

    def stream(
        self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]], shared: Any
    ) -> Iterator[Result]:
        """See :meth:`calgraph.parallel.engine.Engine.stream`."""
        from distributed import wait

        with self._futures() as submitted:
            handle = self._submit(_return, shared)
            unfinished: set[Future] = set()
            source, limit, counted = iter(work), self._count_ahead(), time.monotonic()
            error: Exception | None = None
            while True:
                try:
                    arguments = next(source)
                except StopIteration:
                    break
                except Exception as raised:
                    error = raised  # earlier results come before it
                    break
                submitted.append(self._submit(function, handle, *arguments))
                unfinished.add(submitted[-1])
                if len(unfinished) >= limit:
                    unfinished = set(wait(unfinished, return_when="FIRST_COMPLETED").not_done)
                    if time.monotonic() - counted > _COUNT_INTERVAL:
                        limit, counted = self._count_ahead(), time.monotonic()
                while submitted and submitted[0].done():
                    yield submitted.popleft().result()
            while submitted:
                yield submitted.popleft().result()
        if error is not None:
            raise error

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:  # noqa: ARG002
        """See :meth:`Engine.keep_workers`: workers of a cluster stay, with separate limits."""
        return nullcontext(self)

    def _count_ahead(self) -> int:
        """The number of unfinished calls of a stream; workers may come and go."""
        return self._settings.calls_ahead * max(self.workers, 1)

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> "Future":
        return self._client.submit(function, *arguments, pure=False, retries=self._settings.retries)

    @contextmanager
    def _futures(self) -> "Iterator[deque[Future]]":
        """Futures that are cancelled if the block fails, or is left."""
        submitted: deque[Future] = deque()
        try:
            with self._explained_errors():
                yield submitted
        finally:
            if self._client.status == "running":
                self._client.cancel(list(submitted))

    @contextmanager
    def _explained_errors(self) -> Iterator[None]:
        """Converts errors of the cluster into those of calgraph.

        Raises:
            CalibrationError: the scheduler was lost, or a call ends all workers.
        """
        from asyncio import CancelledError as TaskCancelled
        from concurrent.futures import CancelledError

        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        try:
            yield
        except KilledWorker as error:
            raise WorkerKilledError(
                "several workers of the cluster were lost by the same call, perhaps because memory ran out; give "
                "each worker more"
            ) from error
        except (CancelledError, TaskCancelled, CommClosedError) as error:
            raise CalibrationError(
                f"the scheduler at {self._address} was lost; run the command again: what was finished is taken "
                "from the cache"
            ) from error


def _return(value: Result) -> Result:
    """The value: as the result of a task, Dask computes it again where it is lost."""
    return value

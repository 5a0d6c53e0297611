"""Connections to clusters, and clusters of this machine."""

import logging
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from itertools import takewhile
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError, WorkerKilledError
from calgraph.io.atomic import temporary_folder
from calgraph.parallel.engine import MapEngine
from calgraph.parallel.kept_values import Kept

if TYPE_CHECKING:
    from distributed import Client, Future


Result = TypeVar("Result")

# Between two questions how many workers there are, s: each takes milliseconds, and workers take seconds to start.
_COUNT_INTERVAL = 1.0


class DaskEngine:
    """Calls on the workers of a cluster; see :class:`calgraph.parallel.engine.Engine`.

    A call of a worker that is lost is repeated on another one. Kept values are futures: those that are given are
    part of a task, and remain in the scheduler's memory.

    Args:
        client: connected.
        settings: of clusters.
    """

    jobs = 1
    """Threads of the client are running, and a process with threads should not be forked."""

    def __init__(self, client: "Client", settings: DaskSettings) -> None:
        self._client, self._settings = client, settings
        self._address = str(client.scheduler.address)
        self._kept: WeakKeyDictionary[Kept, Future] = WeakKeyDictionary()

    @property
    def workers(self) -> int:
        """Workers that the cluster has now."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """See :meth:`calgraph.parallel.engine.MapEngine.map`."""
        from distributed import wait

        error: Exception | None = None
        with self._futures() as submitted:
            unfinished: set[Future] = set()
            source, limit, counted = iter(work), self._count_ahead(), time.monotonic()
            while True:
                try:
                    arguments = next(source)
                except StopIteration:
                    break
                except Exception as raised:
                    error = raised  # earlier results come before it
                    break
                submitted.append(self._submit(function, arguments))
                unfinished.add(submitted[-1])
                # Arguments of a list are in memory already.
                if len(unfinished) >= limit and not isinstance(work, Sequence):
                    unfinished = set(wait(unfinished, return_when="FIRST_COMPLETED").not_done)
                    if time.monotonic() - counted > _COUNT_INTERVAL:
                        limit, counted = self._count_ahead(), time.monotonic()
                    yield from self._take_finished(submitted)
            while submitted:
                wait([submitted[0]])
                yield from self._take_finished(submitted)
        if error is not None:
            raise error

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:  # noqa: ARG002
        """See :meth:`Engine.keep_workers`: workers of a cluster stay, with separate limits."""
        return nullcontext(self)

    def _take_finished(self, submitted: "deque[Future]") -> Iterator[Any]:
        """The results of the first calls that have finished, in one transfer, or the error of the very first."""
        finished = list(takewhile(lambda future: future.status == "finished", submitted))
        if finished:
            for result in self._client.gather(finished):
                submitted.popleft()
                yield result
        # Not `done()`: it may have finished since, with a result that is to be given.
        elif submitted and submitted[0].status in ("error", "cancelled"):
            submitted[0].result()

    def _count_ahead(self) -> int:
        """The number of unfinished calls of a stream; workers may come and go."""
        return self._settings.calls_ahead * max(self.workers, 1)

    def _submit(self, function: Callable[..., Any], arguments: Sequence[Any]) -> "Future":
        given = [self._place(argument) if isinstance(argument, Kept) else argument for argument in arguments]
        return self._client.submit(function, *given, pure=False, retries=self._settings.retries)

    def _place(self, kept: Kept) -> "Future":
        """The future of a kept value, which Dask computes again where it is lost."""
        if kept not in self._kept:
            self._kept[kept] = self._submit(*kept.recipe)
        return self._kept[kept]

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


_log = logging.getLogger("calgraph")

LOCAL = "local"
"""In place of an address: processes of this machine."""
_ADDRESS = re.compile(r"(tcp|tls)://[^\s/]+:\d+")
_LOGGERS = ("distributed", "distributed.client")
# What results, or their transport, depend on; workers need not have what only the client uses.
_PROGRAMS = (
    "calgraph", "cloudpickle", "dask", "distributed", "msgpack", "numpy", "opencv-python-headless",
    "pupil-apriltags", "python", "rosbags", "scipy",
)  # fmt: skip


@contextmanager
def open_cluster(
    address: str, workers: int, settings: DaskSettings, *, dashboard: bool = True
) -> Iterator[DaskEngine]:
    """An engine whose calls run on a cluster, for the duration of the block.

    Args:
        address: of a scheduler (``tcp://HOST:PORT`` or ``tls://HOST:PORT``); or :data:`LOCAL`, for processes of
            this machine that end with the block, or with this process.
        workers: number of processes, if they are of this machine.
        settings: of clusters.
        dashboard: whether a cluster of this machine serves Dask's page, at a free port of 127.0.0.1.

    Raises:
        InputError: the address is malformed, or Dask is not installed.
        CalibrationError: nothing answers, there are no workers, or one of them has other versions or several
            threads.
    """
    if address != LOCAL and not _ADDRESS.fullmatch(address):
        raise InputError(
            f"`cluster`: must be {LOCAL}, or the address of a scheduler such as tcp://10.0.0.5:8786, got "
            f"{address!r}"
        )
    try:
        import dask
        import distributed
    except ImportError as error:
        raise InputError(
            "`cluster`: needs Dask, which is not installed: pip install 'calgraph[cluster]'"
        ) from error
    for name in _LOGGERS:
        # What matters of it to a user is an error of calgraph, or on the dashboard.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # Arguments of a call may be larger than Dask expects of tasks.
    options: dict[str, Any] = {"distributed.admin.large-graph-warning-threshold": "1TB"}
    if address == LOCAL:
        options["distributed.scheduler.allowed-failures"] = settings.max_lost_workers
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(options))
        place: Any = address
        if address == LOCAL:
            # Dask's nannies end their workers with this process, however it ends.
            place = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": dashboard},
                    silence_logs=logging.CRITICAL,
                    memory_limit=round(1e9 * (settings.worker_memory or 0.0)),
                    local_directory=str(stack.enter_context(temporary_folder())),
                )
            )
        client = stack.enter_context(_connect_client(place, settings))
        engine = DaskEngine(client, settings)
        _check_workers(client)
        _log.info("cluster: %d workers, dashboard %s", engine.workers, client.dashboard_link)
        yield engine


@contextmanager
def _connect_client(place: Any, settings: DaskSettings) -> "Iterator[Client]":
    """A client of a scheduler with at least one worker."""
    import distributed

    try:
        client = distributed.Client(place, timeout=settings.connect_timeout)
    except (OSError, TimeoutError) as error:
        raise CalibrationError(
            f"{place}: no scheduler of Dask answers within {settings.connect_timeout:g} s "
            "(cluster.connect_timeout): start it, or correct the address"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=settings.worker_timeout)
        except TimeoutError as error:
            raise CalibrationError(
                f"{client.scheduler.address}: has no workers after {settings.worker_timeout:g} s "
                "(cluster.worker_timeout): start some"
            ) from error
        yield client


def _check_workers(client: "Client") -> None:
    """Checks that all workers compute the same as this process, one call at a time.

    Raises:
        CalibrationError: a worker has other versions, or several threads.
    """
    for worker, description in client.scheduler_info(n_workers=-1)["workers"].items():
        if description["nthreads"] != 1:
            raise CalibrationError(
                f"the worker {worker} has {description['nthreads']} threads, and detectors are not made for that: "
                "start workers with `dask worker --nthreads 1 --nworkers auto`"
            )
    versions = client.get_versions(packages=list(_PROGRAMS))
    own = versions["client"]["packages"]
    for worker, description in versions["workers"].items():
        others = description["packages"]
        if differing := [name for name in _PROGRAMS if own[name] != others.get(name)]:
            named = (f"{name} {others.get(name) or 'is missing'} in place of {own[name]}" for name in differing)
            raise CalibrationError(
                f"the worker {worker} has other versions than this computer: {', '.join(named)}; install the same"
            )

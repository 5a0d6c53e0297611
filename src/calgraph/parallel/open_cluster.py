"""Connections to clusters, and clusters of this machine."""

import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.io.atomic import temporary_folder
from calgraph.parallel.dask_engine import DaskEngine

if TYPE_CHECKING:
    from distributed import Client

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
        if differing := _compare_versions(own, description["packages"]):
            raise CalibrationError(
                f"the worker {worker} has other versions than this computer: {differing}; install the same"
            )


def _compare_versions(own: Mapping[str, str | None], others: Mapping[str, str | None]) -> str:
    """Where versions differ, in words; empty if they do not."""
    return ", ".join(
        f"{name} {others.get(name) or 'is missing'} in place of {own[name]}"
        for name in _PROGRAMS
        if own[name] != others.get(name)
    )

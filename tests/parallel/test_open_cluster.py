"""Clusters that are opened, or cannot be: what is said, and that nothing is left."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import Client

from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.parallel.open_cluster import open_cluster
from dask_programs import start_scheduler, start_worker, stop

SETTINGS = DaskSettings(connect_timeout=30.0, worker_timeout=60.0)


def open_and_count(address: str, settings: DaskSettings = SETTINGS) -> int:
    with open_cluster(address, 1, settings) as engine:
        return engine.workers


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler."""
    process, address = start_scheduler(tmp_path_factory.mktemp("scheduler"))
    yield address
    stop(process)


@pytest.mark.parametrize("address", ["10.0.0.5:8786", "tcp://", "http://10.0.0.5:8786", "Local", "tcp://host"])
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(
        InputError, match="`cluster`: must be local, or the address of a scheduler such as tcp://10"
    ):
        open_and_count(address)


def test_the_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"Dask, which is not installed: pip install 'calgraph\[cluster\]'"):
        open_and_count("local")


def test_nothing_answers() -> None:
    with pytest.raises(CalibrationError, match=r"^tcp://127\.0\.0\.1:1: no scheduler of Dask answers within 1 s"):
        open_and_count("tcp://127.0.0.1:1", DaskSettings(connect_timeout=1.0))


def test_a_scheduler_without_workers_is_named(scheduler: str) -> None:
    with pytest.raises(CalibrationError, match=rf"^{scheduler}: has no workers after 0\.5 s"):
        open_and_count(scheduler, DaskSettings(connect_timeout=30.0, worker_timeout=0.5))


def test_workers_with_several_threads_are_refused(scheduler: str) -> None:
    worker = start_worker(scheduler, threads=2)
    try:
        with pytest.raises(
            CalibrationError, match=r"has 2 threads, .* `dask worker --nthreads 1 --nworkers auto`"
        ):
            open_and_count(scheduler)
    finally:
        stop(worker)


def test_workers_with_other_versions_are_refused(scheduler: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def change(client: Client, packages: list[str]) -> Any:
        found = original(client, packages=packages)
        for description in found["workers"].values():
            description["packages"] |= {"numpy": "1.0", "calgraph": None}
        return found

    original = Client.get_versions
    worker = start_worker(scheduler)
    try:
        assert open_and_count(scheduler) == 1
        monkeypatch.setattr(Client, "get_versions", change)
        with pytest.raises(
            CalibrationError,
            match=r"other versions .*: calgraph is missing in place of .*, numpy 1\.0 in place of",
        ):
            open_and_count(scheduler)
    finally:
        stop(worker)


PROGRAM = """
import os, signal, sys, time
from calgraph.parallel.open_cluster import open_cluster
from calgraph.config.settings import DaskSettings
from calgraph.io.termination import handle_signals

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
    handle_signals()
    with open_cluster("local", 2, DaskSettings(), dashboard=False) as engine:
        print(*set(engine.map(os.getpid, [()] * 20)), flush=True)
        list(engine.map(time.sleep, [(60.0,)]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_of_this_machine_end_with_the_program(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment,
    ) as program:  # fmt: skip
        assert program.stdout is not None
        workers = [int(one) for one in program.stdout.readline().split()]
        children = psutil.Process(program.pid).children(recursive=True)
        program.send_signal(number)
        _, errors = program.communicate(timeout=60)
    assert workers
    assert program.returncode == (-number if number == signal.SIGKILL else 128 + number)
    assert "Traceback" not in errors
    ends = time.monotonic() + 30
    while any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children):
        assert time.monotonic() < ends
        time.sleep(0.1)
    if number != signal.SIGKILL:
        assert not list(tmp_path.glob("*calgraph*"))

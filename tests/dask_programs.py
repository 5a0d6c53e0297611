"""Schedulers and workers of Dask as separate processes, as on other machines."""

import subprocess
import sys
import time
from pathlib import Path


def start_scheduler(folder: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A scheduler at a free port of 127.0.0.1, and its address; its files are in the folder."""
    port = folder / "address"
    # An earlier scheduler of the same folder listens no longer.
    port.unlink(missing_ok=True)
    program = (
        "import asyncio, pathlib\n"
        "from distributed import Scheduler\n"
        "async def serve():\n"
        "    async with Scheduler(host='127.0.0.1', port=0, dashboard=False) as scheduler:\n"
        f"        pathlib.Path({str(port)!r} + '.part').write_text(scheduler.address)\n"
        f"        pathlib.Path({str(port)!r} + '.part').rename({str(port)!r})\n"
        "        await scheduler.finished()\n"
        "asyncio.run(serve())\n"
    )
    started = _start("-c", program)
    ends = time.monotonic() + 60
    while not port.exists():
        assert started.poll() is None
        assert time.monotonic() < ends
        time.sleep(0.05)
    return started, port.read_text()


def start_worker(address: str, threads: int = 1) -> subprocess.Popen[bytes]:
    """A worker of a scheduler."""
    return _start(
        "-m", "distributed.cli.dask_worker", address, "--nthreads", str(threads), "--no-nanny", "--no-dashboard",
        "--host", "127.0.0.1", "--death-timeout", "60",
    )  # fmt: skip


def stop(*processes: subprocess.Popen[bytes]) -> None:
    """Kills processes, and waits for their end."""
    for process in processes:
        process.kill()
        process.wait()


def _start(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

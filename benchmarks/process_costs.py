"""Time and memory of this process, of those that it starts, and of commands: Linux, from /proc."""

import multiprocessing
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
Result = TypeVar("Result")
_TICK = 1 / os.sysconf("SC_CLK_TCK")
_SAMPLING_INTERVAL = 0.1
"""Between two measurements of the memory of all processes, s: at 0.02 s, they took 0.3 s of the wall time of four
processes, which wait while their memory is measured."""


@dataclass(frozen=True)
class Cost:
    """What one run of a command took."""

    wall: float
    """s."""
    cpu: float
    """s, user and system, of all threads and processes."""
    peak: float
    """Largest sum of the memory of all processes, bytes; pages that several share count once."""


def measure_cost(command: Sequence[str], environment: dict[str, str]) -> Cost:
    """What a command takes; the program ends if it fails."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment)
    sizes, stopped = [float("nan")], threading.Event()

    def sample() -> None:
        while not stopped.wait(_SAMPLING_INTERVAL):
            sizes.append(measure_memory([process.pid, *list_descendants(process.pid)]))

    sampler = threading.Thread(target=sample, daemon=True)
    sampler.start()
    # wait4 returns the usage of this process and of those it waited for; RUSAGE_CHILDREN would mix the runs.
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - began
    stopped.set()
    sampler.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{' '.join(command)} failed with exit code {process.returncode}")
    return Cost(wall, usage.ru_utime + usage.ru_stime, max(sizes[1:], default=sizes[0]))


def in_process(function: Callable[P, Result], *arguments: P.args, **named: P.kwargs) -> Result:
    """Calls a function in another process, so that time and memory are its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **named).result()


def list_descendants(process: int) -> Iterator[int]:
    """The children of a process, and theirs."""
    for listed in Path(f"/proc/{process}/task").glob("*/children"):
        for child in map(int, _read_text(listed).split()):
            yield child
            yield from list_descendants(child)


def measure_memory(processes: Iterable[int]) -> float:
    """Memory of processes, bytes; a page that n processes share counts as 1/n of each."""
    lines = (line for one in processes for line in _read_text(Path(f"/proc/{one}/smaps_rollup")).splitlines())
    return float(sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:")))


def measure_cpu() -> float:
    """Processor time of this process, of those it has started that have ended, and of those that run, s."""
    done = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    running = sum(map(measure_processor_time, list_descendants(os.getpid())))
    return sum(one.ru_utime + one.ru_stime for one in done) + running


def measure_processor_time(process: int) -> float:
    """Processor time of a process until now and of its children that have ended, s; 0 if it has ended."""
    # After the name, which may have spaces, fields 14 to 17 are its own times and those of its children.
    fields = _read_text(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()
    return sum(int(field) for field in fields[11:15]) * _TICK


def measure_peak_memories() -> tuple[float, float]:
    """Most memory that this process held, and that any of those that it started and that have ended did, MB."""
    own, others = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own / 1024, others / 1024


def _read_text(path: Path) -> str:
    """Of a file in /proc; empty where the process has ended."""
    try:
        return path.read_text()
    except OSError:
        return ""

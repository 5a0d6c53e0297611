"""Time and memory of this process, of those that it starts, and of commands, on Linux."""

import multiprocessing
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import psutil

P = ParamSpec("P")
Result = TypeVar("Result")
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
            with suppress(psutil.Error):  # it has ended
                sizes.append(measure_memory(list_processes(process.pid)))

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


def list_processes(process: int | None = None) -> list[psutil.Process]:
    """A process, this one if left out, and all that it has started, directly or not."""
    first = psutil.Process(process)
    return [first, *first.children(recursive=True)]


def measure_memory(processes: Iterable[psutil.Process]) -> float:
    """Memory of processes, bytes; a page that n processes share counts as 1/n of each."""
    total = 0.0
    for one in processes:
        with suppress(psutil.Error):  # it has ended
            total += one.memory_full_info().pss
    return total


def measure_cpu() -> float:
    """Processor time of this process, of those it has started that have ended, and of those that run, s."""
    return sum(map(measure_processor_time, list_processes()))


def measure_processor_time(process: psutil.Process) -> float:
    """Processor time of a process until now and of its children that have ended, s; 0 if it has ended."""
    with suppress(psutil.Error):
        return float(sum(process.cpu_times()[:4]))
    return 0.0


def measure_peak_memories() -> tuple[float, float]:
    """Most memory that this process held, and that any of those that it started and that have ended did, MB."""
    own, others = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own / 1024, others / 1024

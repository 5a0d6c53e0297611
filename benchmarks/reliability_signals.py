"""Attempts with signals at random times: SIGKILL, SIGTERM, SIGINT and SIGHUP, and SIGKILL of one worker."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from reliability_answers import Answer, Judged, find_left, judge_ending
from reliability_cases import Case
from reliability_runs import processes_of_session, run
from reliability_tasks import MIXED, NEW, TASKS, References, Task, fingerprint, link_documents, state_of

TABLE = "signals"
NOT_HIT = "ended before"
_SIGNALS = {
    "SIGKILL": signal.SIGKILL,
    "SIGTERM": signal.SIGTERM,
    "SIGINT (Ctrl-C)": signal.SIGINT,
    "SIGHUP (terminal closed)": signal.SIGHUP,
}
_TWICE = "SIGINT, and SIGTERM soon after"
_WORKER = "SIGKILL of one worker"
KINDS = *_SIGNALS, _TWICE, _WORKER
_CODES: Mapping[str, tuple[int, ...]] = {
    # Negative where the signal comes before the first line of calgraph, or after its last.
    **{kind: (-number, 128 + number) for kind, number in _SIGNALS.items()},
    "SIGKILL": (-9,),
    _TWICE: (-2, 130, -15, 143),
    _WORKER: (1,),
}
_LONGEST_END = 5.0
"""A run must have ended this long after a signal, s."""


def list_cases(references: References, seeds: int) -> Iterator[Case]:
    """Signals at random times."""
    for seed in range(12 * seeds):
        for kind in KINDS:
            for task in TASKS:
                if (task.workers or kind != _WORKER) and not (task.heavy and seed % 6):
                    yield Case(TABLE, kind, task.name, seed, partial(_attempt, references, task, kind))


def _send(delay: float, kind: str, process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    number = _SIGNALS.get(kind, signal.SIGINT)
    # A terminal sends its signals to all processes of a command.
    send = os.killpg if number in (signal.SIGINT, signal.SIGHUP) else os.kill
    with suppress(ProcessLookupError):
        if process.returncode is None:
            send(process.pid, number)
        if kind == _TWICE:
            time.sleep(delay % 0.05)
            send(process.pid, signal.SIGTERM)


def _kill_worker(delay: float, _kind: str, process: subprocess.Popen[bytes]) -> None:
    time.sleep(delay)
    workers = [pid for pid in processes_of_session(process.pid) if pid != process.pid]
    if workers:
        os.kill(workers[int(1000 * delay) % len(workers)], signal.SIGKILL)


def _attempt(references: References, task: Task, kind: str, folder: Path, rng: np.random.Generator) -> Judged:
    link_documents(references.whole, folder)
    earlier, new, duration = references.states[task.name]
    references.prepare(task, folder)
    # The second half of the times is among the last 40 %, where results are written.
    delay = duration * (rng.uniform(0, 1) if rng.random() < 0.5 else rng.uniform(0.6, 1.1))
    disturb = partial(_kill_worker if kind == _WORKER else _send, delay, kind)
    ending = run(task.command, folder, disturb=disturb)
    names = ["a process was killed", "killed"]
    if (found := judge_ending(ending, names, (0, *_CODES[kind]))) and found.answer.is_wrong:
        return found
    state = state_of(folder / task.output, earlier, new)
    if state == MIXED:
        return Judged(Answer.HALF, f"{ending.code}: {sorted(fingerprint(folder / task.output))}")
    if ending.code == 0 and state != NEW:
        return Judged(Answer.HALF, f"exit code 0 and {state}")
    if kind != "SIGKILL" and (left := find_left(folder)):
        return Judged(Answer.LEFT, left[0])
    if kind not in ("SIGKILL", _WORKER):
        late = ending.seconds - delay
        if ending.code != 0 and late > _LONGEST_END:
            return Judged(Answer.HANG, f"ended {late:.1f} s after the signal")
        # Nothing is left to be removed, and what a next run finds is what this one found.
        return Judged(Answer.RIGHT, NOT_HIT if ending.code == 0 else state)
    again = run([*task.command, *(task.again if state == NEW else ())], folder)
    refused = task.refused_over_new and state == NEW
    if again.code != (2 if refused else 0):
        return Judged(Answer.CRASH, f"the next run failed: {again.stderr[-300:]}")
    if state_of(folder / task.output, earlier, new) != NEW:
        return Judged(Answer.HALF, "the next run wrote something else")
    if left := find_left(folder):
        return Judged(Answer.LEFT, f"after the next run: {left[0]}")
    return Judged(Answer.RIGHT, NOT_HIT if ending.code == 0 else state)

"""Progress and steps of the work on stderr: bars once it takes longer than two seconds, lines on request."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from calgraph.cli.console import console
from calgraph.io.termination import add_cleanup, remove_cleanup

_log = logging.getLogger("calgraph")
_MIN_DURATION = 2.0
"""Work that is done sooner shows no bar, s."""
_LEAST_CHANGE = 0.005
"""A change of the share that is done by less than this is not visible."""


@contextmanager
def progress_bars() -> Iterator[Callable[[str, float], None]]:
    """Gives a function that shows how much (0..1) of a named step is done; silent where stderr is no terminal."""
    stderr = console(stderr=True)
    columns = (
        TextColumn("{task.description:<11}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
    )
    bars = Progress(
        *columns, console=stderr, disable=not stderr.is_terminal or _log.isEnabledFor(logging.INFO), transient=True
    )
    tasks: dict[str, TaskID] = {}
    starts: dict[str, float] = {}
    shown: dict[str, float] = {}
    began = time.monotonic()

    def show(step: str, done: float) -> None:
        if step in starts and shown[step] <= done < min(shown[step] + _LEAST_CHANGE, 1.0):
            return
        shown[step] = done
        if step not in tasks:
            tasks[step] = bars.add_task(step, total=1.0)
        if step not in starts:
            starts[step] = time.monotonic()
        if done >= 1:
            _log.info("%s: done in %.1f s", step, time.monotonic() - starts.pop(step))
        bars.update(tasks[step], completed=min(max(done, 0.0), 1.0))
        if not bars.live.is_started and time.monotonic() - began > _MIN_DURATION:
            add_cleanup(bars, bars.stop)  # it hides the cursor
            bars.start()

    try:
        yield show
    finally:
        bars.stop()
        remove_cleanup(bars)


VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Log each step with counts and times on stderr.")
]


def log_steps() -> None:
    """Shows what is logged from now on, each line with the time since then."""
    began = time.time()

    def add_time(record: logging.LogRecord) -> bool:
        record.since = record.created - began
        return True

    handler = logging.StreamHandler()
    handler.addFilter(add_time)
    handler.setFormatter(logging.Formatter("calgraph: %(since)6.1f s  %(message)s"))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)

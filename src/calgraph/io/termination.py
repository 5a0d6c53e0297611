"""The end of a program by SIGINT, SIGTERM or SIGHUP: temporary files and workers are removed, and it ends.

Handlers that raise exceptions are not sufficient: libraries discard some of them (while an object is deleted, or
by a bare ``except``), and the program would continue; others interrupt a cleanup. Programs that use calgraph as a
library handle signals as they like.
"""

import os
import signal
from collections.abc import Callable, Hashable
from contextlib import suppress
from types import FrameType

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals of users, their terminals and the system that end a program; Windows has no SIGHUP."""
# Removing the temporary files of one run takes less, s. A cleanup that waits for something ends with the process.
_MAX_CLEANUP_TIME = 10.0
_cleanups: dict[Hashable, Callable[[], object]] = {}
"""What is to be done if the program ends now, the last first."""


def add_cleanup(key: Hashable, cleanup: Callable[[], object]) -> None:
    """Has something done if a signal ends the program, before what is to be done already.

    Args:
        key: by which :func:`remove_cleanup` finds it.
        cleanup: called between any two instructions of the main thread.
    """
    _cleanups[key] = cleanup


def remove_cleanup(key: Hashable) -> None:
    """No longer has it done, if it was to be."""
    _cleanups.pop(key, None)


def handle_signals() -> None:
    """From now on signals end this process, with the exit code that shells give them.

    Signals that are ignored remain so: ``nohup`` and shells start programs in the background like this.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _terminate)


def allow_interrupts() -> None:
    """From now on SIGINT raises KeyboardInterrupt, as Python does: where Ctrl-C is the regular end."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def handle_interrupt(function: Callable[[], object]) -> None:
    """From now on the first SIGINT calls a function, and further ones nothing: Ctrl-C is often pressed twice."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        function()

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, interrupt)


def _terminate(number: int, _frame: FrameType | None) -> None:
    try:
        # Ctrl-C is often pressed twice.
        for other in SIGNALS:
            signal.signal(other, signal.SIG_IGN)
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, _MAX_CLEANUP_TIME)
        for cleanup in reversed(list(_cleanups.values())):
            with suppress(Exception):
                cleanup()
    finally:
        os._exit(128 + number)

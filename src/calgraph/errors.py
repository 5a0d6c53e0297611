"""Exceptions raised on purpose, and :class:`Rejected`, the value returned where data do not suffice.

Each message names what is wrong, where, and what would be right.
"""

from dataclasses import dataclass


class CalgraphError(Exception):
    """Base class of errors that users can cause; the command line prints the message in one line."""


class InputError(CalgraphError):
    """A file, key or value given by the user cannot be used (exit code 2)."""


class RecordingError(InputError):
    """A recording cannot be opened, or yields other messages than it states."""


class CalibrationError(CalgraphError):
    """The requested calibration cannot be computed (exit code 1).

    The data do not determine it, or the computer lacks memory or processes.
    """


class WorkerKilledError(CalibrationError):
    """A process that worked on a call was killed, as systems do when memory runs out."""


@dataclass(frozen=True)
class Rejected:
    """Returned instead of a result where the data of a step do not suffice, with the reason."""

    reason: str
    """One sentence that a user can act on."""

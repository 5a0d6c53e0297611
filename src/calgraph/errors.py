"""Exceptions raised on purpose, and :class:`Rejected`, the value returned where data do not suffice.

Each message names what is wrong, where, and what would be right.
"""

from dataclasses import dataclass


class CalgraphError(Exception):
    """Base of every error a user can cause or meet; the launcher prints its message on one line."""


class InputError(CalgraphError):
    """A file, key or value given by the user cannot be used (exit code 2)."""


class RecordingError(InputError):
    """A recording cannot be opened, or yields other messages than it states."""


class CalibrationError(CalgraphError):
    """The data do not determine the requested calibration (exit code 1)."""


@dataclass(frozen=True)
class Rejected:
    """A value instead of a result: the data of one step do not suffice, and why."""

    reason: str
    """One sentence that a user can act on."""

"""Errors that calgraph raises on purpose: each says what was wrong, where, and what would be right."""


class CalgraphError(Exception):
    """Base of every error a user can cause or meet; the launcher prints its message on one line."""


class InputError(CalgraphError):
    """A file, key or value given by the user cannot be used (exit code 2)."""


class RecordingError(InputError):
    """A recording cannot be opened, or yields other messages than it states."""


class CalibrationError(CalgraphError):
    """The data do not determine the calibration asked for (exit code 1)."""

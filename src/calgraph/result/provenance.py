"""Where a calibration comes from: program, command, and the files that it was computed from."""

from dataclasses import dataclass


@dataclass(frozen=True)
class InputFile:
    """A file or folder that a calibration was computed from."""

    path: str
    """As it was given."""
    sha256: str
    """Of its size, first and last mebibyte; of a folder, of all files in it."""


@dataclass(frozen=True)
class Provenance:
    """How a calibration was computed."""

    version: str
    """Of calgraph."""
    date: str
    """UTC, ISO 8601."""
    command: str
    """The command line."""
    inputs: tuple[InputFile, ...]
    """The rig, the recordings, and all other files that were read."""
    start: float | None = None
    """Start of the recording, s; None where there was none."""
    duration: float | None = None
    """Of the recording, s."""
    messages: int | None = None
    """Number of messages in the recording."""
    cached: tuple[str, ...] = ()
    """Sensors whose detections were taken from an earlier run on the same recording."""

"""Provenance of the results of a command."""

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

from calgraph.calibration.result_files import make_provenance
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.result import Provenance


def format_command() -> str:
    """The command line of this program."""
    return shlex.join(["calgraph", *sys.argv[1:]])


def describe_run(
    inputs: Iterable[tuple[str, Path | str]], recording: Recording | None = None, cache: RecordingCache = NO_CACHE
) -> Provenance:
    """The provenance of what the running command computes; arguments are those of :func:`make_provenance`."""
    return make_provenance(format_command(), inputs, recording, cache)

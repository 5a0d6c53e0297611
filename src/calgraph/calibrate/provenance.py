"""Provenance of results: program, command, and the files that they were computed from."""

import hashlib
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.recording.remote import find_copy, is_url
from calgraph.result import InputFile, Provenance

# Bytes of each end of a file that are hashed: recordings have gigabytes.
_HASHED_BYTES = 2**20


def make_provenance(
    command: str,
    inputs: Iterable[Path | str],
    recording: Recording | None = None,
    cache: RecordingCache = NO_CACHE,
) -> Provenance:
    """The provenance of what a command computes.

    Args:
        command: the command line.
        inputs: files, folders and URLs that it reads.
        recording: the recording among them, open.
        cache: where detections may have been taken from.
    """
    provenance = Provenance(
        version=version("calgraph"),
        date=_now().isoformat(timespec="seconds"),
        command=command,
        inputs=tuple(InputFile(str(path), hash_input(path)) for path in inputs),
    )
    if recording is None:
        return provenance
    messages = sum(topic.count for topic in recording.topics)
    return replace(
        provenance,
        start=recording.start,
        duration=recording.end - recording.start,
        messages=messages,
        cached=tuple(sorted(cache.reused)),
    )


def hash_input(place: Path | str) -> str:
    """SHA-256 of the sizes and of both ends of a file, or of all files of a folder in the order of their names.

    That of a URL is its copy's. Empty for pipes and devices, which cannot be read again.
    """
    path = find_copy(str(place)) if is_url(place) else Path(place)
    if path is None:
        return ""
    if not path.is_file() and not path.is_dir():
        return ""
    digest = hashlib.sha256()
    for file in sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else [path]:
        size = file.stat().st_size
        digest.update(str(size).encode())
        with file.open("rb") as opened:
            digest.update(opened.read(_HASHED_BYTES))
            opened.seek(max(size - _HASHED_BYTES, 0))
            digest.update(opened.read(_HASHED_BYTES))
    return digest.hexdigest()


def _now() -> datetime:
    """The time of the run; SOURCE_DATE_EPOCH where it is a number, for builds that are to be reproduced."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    with suppress(ValueError, OverflowError, OSError):
        return datetime.fromtimestamp(int(epoch), UTC)
    return datetime.now(UTC)

"""The files of a result."""

import hashlib
import logging
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.config import Rig, Tolerance
from calgraph.io.text_writing import format_json, save_yaml
from calgraph.parallel.engine import parallel_call
from calgraph.parallel.processes import forked_jobs
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.recording.remote import find_copy, is_url
from calgraph.result import (
    Calibration,
    InputFile,
    Provenance,
    save_budget,
    save_calibration,
    save_captures,
    save_residuals,
    save_scene,
)

if TYPE_CHECKING:
    from calgraph.verdict.comparison import ExtrinsicsComparison


_CHECK_FORMAT = "calgraph-check/1"
_log = logging.getLogger("calgraph")


def write_results(calibration: Calibration, rig: Rig, folder: Path, jobs: int = 1) -> None:
    """Writes the files of a calibration into an existing folder, in up to ``jobs`` processes."""
    from calgraph.report import write_report  # brings plots along, which take a second

    jobs = forked_jobs(jobs)
    with parallel_call(_write_tables, (calibration, rig, folder), jobs) as written:
        write_report(calibration, rig, folder / "report.html", max(jobs - 1, 1))
        written()
    _log.info("results: written")


def _write_tables(calibration: Calibration, rig: Rig, folder: Path) -> None:
    """Writes all files but the report, which takes longer than these together."""
    save_calibration(calibration, folder / "calibration.yaml")
    save_yaml(folder / "rig.resolved.yaml", rig.to_plain())
    save_residuals(calibration, folder / "residuals.csv")
    save_scene(calibration.pictures, folder / "scene.npz")
    save_captures(calibration, folder / "captures.csv")
    save_budget(calibration, folder / "budget.csv")


def format_comparison(comparison: "ExtrinsicsComparison", against: Path, tolerance: Tolerance) -> str:
    """check.json: a comparison with given extrinsics; what is not finite is null."""
    content: dict[str, Any] = {
        "format": _CHECK_FORMAT,
        "against": str(against),
        "outcome": comparison.outcome,
        "tolerance": {"position": tolerance.translation, "rotation": float(np.radians(tolerance.rotation))},
        **asdict(comparison),
    }
    return format_json(content, indent=1)


# Bytes of each end of a file that are hashed: recordings have gigabytes.
_HASHED_BYTES = 2**20


def make_provenance(
    command: str,
    inputs: Iterable[tuple[str, Path | str]],
    recording: Recording | None = None,
    cache: RecordingCache = NO_CACHE,
) -> Provenance:
    """The provenance of what a command computes.

    Args:
        command: the command line.
        inputs: kinds, as :attr:`InputFile.kind` has them, with the files, folders and URLs that it reads.
        recording: the recording among them, open.
        cache: where detections may have been taken from.
    """
    provenance = Provenance(
        version=version("calgraph"),
        date=_now().isoformat(timespec="seconds"),
        command=command,
        inputs=tuple(InputFile(str(path), hash_input(path), kind) for kind, path in inputs),
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

"""The files of a result."""

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calgraph.config import Rig, Tolerance
from calgraph.io.json_writing import format_json
from calgraph.io.yaml_writing import save_yaml
from calgraph.parallel.processes import forked_jobs, parallel_call
from calgraph.result import Calibration, save_calibration, save_captures, save_residuals, save_scene

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

"""report.html: one self-contained page on the calibration and its reliability."""

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.config import Rig
from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.io.atomic import write_text
from calgraph.parallel.engine import parallel_call
from calgraph.parallel.processes import forked_jobs
from calgraph.report.budget_view import render_budget
from calgraph.report.capture_view import render_captures
from calgraph.report.coverage_view import render_coverage
from calgraph.report.drive_view import render_drive
from calgraph.report.floor_view import place_on_plan, render_floor_plan
from calgraph.report.formatting import format_base
from calgraph.report.fused_view import render_fused_cloud
from calgraph.report.gallery import render_gallery
from calgraph.report.graph_view import render_graph
from calgraph.report.image_view import render_camera_images
from calgraph.report.residual_view import render_residual_pictures, render_residuals
from calgraph.report.rig_view import render_rig_view
from calgraph.report.systematic_view import render_systematic_parameters
from calgraph.report.templates import read_asset, render
from calgraph.report.verdict_cards import describe_next_step, render_cards, summarize_verdicts
from calgraph.report.vocabulary import DRIVE_VOCABULARY, SPACE_VOCABULARY, Vocabulary, select_vocabulary
from calgraph.result import Calibration, Provenance
from calgraph.sensors.kinds import KINDS


def write_report(calibration: Calibration, rig: Rig, path: Path | str, jobs: int = 1) -> None:
    """Writes the report as one self-contained HTML file, in one step.

    Args:
        calibration: to report.
        rig: its configuration. Cameras without intrinsics have no images with overlays;
            :func:`calgraph.recording.resolve_intrinsics` adds them.
        path: the file, e.g. ``OUT/report.html``.
        jobs: maximum number of processes; see :func:`calgraph.parallel.engine.parallel_call`.

    Raises:
        InputError: ``path`` cannot be written.
        CalibrationError: a process was killed.
    """
    jobs = forked_jobs(jobs)
    with (
        parallel_call(render_gallery, (calibration,), jobs) as gallery,
        parallel_call(render_fused_cloud, (calibration, rig), jobs - 1) as cloud,
    ):
        write_text(Path(path), _render_page(calibration, rig, gallery, cloud))


def render_report(calibration: Calibration, rig: Rig) -> str:
    """The text of the report."""
    return _render_page(
        calibration, rig, partial(render_gallery, calibration), partial(render_fused_cloud, calibration, rig)
    )


def _render_page(
    calibration: Calibration, rig: Rig, gallery: Callable[[], Markup], cloud: Callable[[], Markup]
) -> str:
    words = select_vocabulary(rig)
    # In the order of the page, but for the results of other processes.
    return render(
        "page.html",
        calibration=calibration,
        words=words,
        tolerance=rig.tolerance,
        confidence=rig.settings.diagnostics.verdict.tolerance_confidence,
        count=_count_items(calibration, words),
        headline=summarize_verdicts(calibration),
        next_step=describe_next_step(calibration),
        cards=render_cards(calibration, rig, words),
        poses=_render_poses(calibration),
        budget=render_budget(calibration),
        graph=render_graph(calibration, words),
        view=render_floor_plan(calibration) if rig.is_network else render_rig_view(calibration, rig),
        space=render_rig_view(place_on_plan(calibration), rig) if words is SPACE_VOCABULARY else "",
        images=render_camera_images(calibration, rig),
        drive=render_drive(calibration),
        errors=render_residual_pictures(calibration, rig, words),
        residuals=render_residuals(calibration, words),
        systematic=render_systematic_parameters(calibration),
        coverage=render_coverage(calibration, rig, words),
        captures=render_captures(calibration, rig, words),
        made=_describe_provenance(calibration.provenance),
        plotly=read_asset("plotly", "package_data/plotly.min.js"),
        gallery=gallery(),
        cloud=cloud(),
    )


def _count_items(calibration: Calibration, words: Vocabulary) -> int | None:
    """Captures of a rig, tracks of a network, or seconds of a drive that were adjusted; None if there are none."""
    if words is DRIVE_VOCABULARY:
        return round(sum(float(np.ptp(path.times)) for path in calibration.pictures.drive_paths)) or None
    return len({row.capture for row in calibration.evidence.captures})


def _render_poses(calibration: Calibration) -> Markup:
    """The table of poses in the root frame, with verdicts and standard deviations."""
    with np.errstate(invalid="ignore"):
        poses = [
            (
                sensor,
                KINDS[sensor.kind].title,
                sensor.T_root_sensor[:3, 3],
                np.degrees(roll_pitch_yaw(sensor.T_root_sensor[:3, :3])),
                np.sqrt(np.diag(sensor.covariance)),
            )
            for sensor in calibration.sensors
        ]
    base_axes = format_base(calibration.base) if calibration.base else {}
    return render("poses.html", calibration=calibration, poses=poses, base_axes=base_axes)


def _describe_provenance(provenance: Provenance | None) -> dict[str, Any] | None:
    """Inputs by kind and the date for the header, and rows of the program, the command and the input files."""
    if provenance is None:
        return None
    rows = [
        ("calgraph", provenance.version),
        ("date", provenance.date),
        ("command", provenance.command),
        *((one.path, f"SHA-256 {one.sha256}") for one in provenance.inputs),
    ]
    inputs: dict[str, str] = {}
    for number, one in enumerate(provenance.inputs):
        kind = one.kind or ("recording" if number else "rig")
        inputs[kind] = f"{inputs[kind]}, {one.path}" if kind in inputs else one.path
    when = ""
    if provenance.start is not None and provenance.duration is not None:
        start = f"{datetime.fromtimestamp(provenance.start, UTC):%Y-%m-%d %H:%M:%S} UTC"
        rows.append(("recording", f"{provenance.duration:.1f} s from {start}, {provenance.messages} messages"))
        when = f"{provenance.duration:.0f} s from {start}"
    if provenance.cached:
        rows.append(("from the cache", f"detections of {', '.join(provenance.cached)}"))
    title = next(iter(inputs.values()), "")
    return {"title": title, "inputs": inputs, "when": when, "date": provenance.date[:10], "rows": rows}

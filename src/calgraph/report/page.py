"""report.html: one self-contained page on the calibration and its reliability."""

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.resources import files
from pathlib import Path
from string import Template

from plotly.offline import get_plotlyjs

from calgraph.config import Rig
from calgraph.io.atomic import write_text
from calgraph.parallel.processes import forked_jobs, parallel_call
from calgraph.report.capture_view import render_captures
from calgraph.report.coverage_view import render_coverage
from calgraph.report.diagnostics_view import (
    render_cross_validation,
    render_suggestions,
    render_systematic_parameters,
)
from calgraph.report.floor_view import render_floor_plan
from calgraph.report.formatting import escape_html, format_count
from calgraph.report.fused_view import render_fused_cloud
from calgraph.report.gallery import render_gallery
from calgraph.report.graph_view import render_edge_table, render_graph
from calgraph.report.image_view import render_camera_images
from calgraph.report.pose_table import render_pose_table
from calgraph.report.residual_view import render_distances, render_histograms, render_residual_pictures
from calgraph.report.rig_view import render_rig_view
from calgraph.report.verdict_cards import (
    describe_good,
    describe_next_step,
    render_cards,
    render_remarks,
    summarize_verdicts,
)
from calgraph.report.vocabulary import NETWORK_VOCABULARY, Vocabulary, select_vocabulary
from calgraph.result import Calibration


def write_report(calibration: Calibration, rig: Rig, path: Path | str, jobs: int = 1) -> None:
    """Writes the report as one self-contained HTML file, in one step.

    Args:
        calibration: to report.
        rig: its configuration. Cameras without intrinsics have no images with overlays;
            :func:`calgraph.recording.resolve_intrinsics` adds them.
        path: the file, e.g. ``OUT/report.html``.
        jobs: maximum number of processes; see :func:`calgraph.parallel.processes.parallel_call`.

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


def _render_page(calibration: Calibration, rig: Rig, gallery: Callable[[], str], cloud: Callable[[], str]) -> str:
    words = select_vocabulary(rig)
    systematic, coverage = render_systematic_parameters(calibration), render_coverage(calibration, rig, words)
    errors = render_residual_pictures(calibration, rig, words)
    sections = {
        "images": ("Camera images", render_camera_images(calibration, rig)),
        "cloud": ("Fused cloud", cloud()),
    }
    shown = {name: (title, content) for name, (title, content) in sections.items() if content}
    return Template(_read_asset("page.html")).substitute(
        title=escape_html(f"Calibration of {calibration.root} and {len(rig.sensors) - 1} more"),
        headline=escape_html(summarize_verdicts(calibration)),
        next_step=describe_next_step(calibration),
        facts=_render_facts(calibration, words),
        about_verdict=describe_good(rig.tolerance, rig.settings.diagnostics.verdict.tolerance_confidence),
        cards=render_cards(calibration, words) + render_remarks(calibration) + render_suggestions(calibration),
        about_graph=words.graph_caption,
        graph=render_graph(calibration, words),
        edges=render_edge_table(calibration, words),
        poses=render_pose_table(calibration),
        errors=errors,
        residuals=render_histograms(calibration, words)
        + render_distances(calibration, words)
        + render_cross_validation(calibration),
        view_title=words.view_title,
        about_view=words.view_caption,
        view=render_floor_plan(calibration) if words is NETWORK_VOCABULARY else render_rig_view(calibration, rig),
        links="".join(f'<a href="#{name}">{title}</a>' for name, (title, _) in shown.items()),
        images="".join(
            f'<section id="{name}"><h2>{title}</h2>{content}</section>' for name, (title, content) in shown.items()
        ),
        coverage=coverage,
        captures_title=words.items_title,
        captures=render_captures(calibration, words) + gallery(),
        systematic=systematic,
        systematic_link='<a href="#systematic">Systematic parameters</a>' if systematic else "",
        provenance=render_provenance(calibration),
        style=_read_asset("style.css"),
        plotly=get_plotlyjs(),
        script=_read_asset("page.js"),
        saving=_read_asset("saving.js"),
    )


def _read_asset(name: str) -> str:
    return files("calgraph.report").joinpath(name).read_text(encoding="utf-8")


def _render_facts(calibration: Calibration, words: Vocabulary) -> str:
    count = len({row.capture for row in calibration.evidence.captures})
    facts = [
        f"root {calibration.root}",
        format_count(count, words.item),
        f"estimator {calibration.evidence.estimator}",
    ]
    if calibration.evidence.bodies:
        facts.append(f"targets: {calibration.evidence.bodies}")
    return " · ".join(map(escape_html, facts))


def render_provenance(calibration: Calibration) -> str:
    """The program, the command and the input files, as HTML; nothing where they are unknown."""
    provenance = calibration.provenance
    if provenance is None:
        return ""
    rows = [
        ("calgraph", provenance.version),
        ("date", provenance.date),
        ("command", provenance.command),
        *((one.path, f"SHA-256 {one.sha256}") for one in provenance.inputs),
    ]
    if provenance.start is not None and provenance.duration is not None:
        start = datetime.fromtimestamp(provenance.start, UTC).isoformat(timespec="seconds")
        rows.append(("recording", f"{provenance.duration:.1f} s from {start}, {provenance.messages} messages"))
    if provenance.cached:
        rows.append(("from the cache", f"detections of {', '.join(provenance.cached)}"))
    cells = "".join(f"<tr><th scope=row>{escape_html(k)}</th><td>{escape_html(v)}</td></tr>" for k, v in rows)
    return f'<section id="provenance"><h2>Provenance</h2><div class="wide"><table>{cells}</table></div></section>'

"""report.html: one page, which needs nothing else, on what was found and how far it can be relied on."""

from importlib.resources import files
from pathlib import Path
from string import Template

from plotly.offline import get_plotlyjs

from calgraph.config import Rig
from calgraph.io import write_text
from calgraph.report.capture_view import captures
from calgraph.report.coverage_view import coverages
from calgraph.report.diagnostics_view import left_out_table, suggestion_list
from calgraph.report.floor_view import floor_plan
from calgraph.report.formatting import counted, escaped
from calgraph.report.fused_view import fused_view
from calgraph.report.gallery import gallery
from calgraph.report.graph_view import edge_table, graph
from calgraph.report.image_view import camera_images
from calgraph.report.pose_table import estimated_table, pose_table
from calgraph.report.residual_view import histograms, spreads
from calgraph.report.rig_view import rig_view
from calgraph.report.verdict_cards import cards, headline, remark_list
from calgraph.report.vocabulary import NETWORK, Words, words_for
from calgraph.result import Calibration


def write_report(calibration: Calibration, rig: Rig, path: Path) -> None:
    """Writes the report as one self-contained HTML file, in one step.

    Args:
        calibration: what was found.
        rig: what was asked for. Cameras whose intrinsics it does not state have no pictures with boards:
            :func:`calgraph.recording.with_intrinsics` states them.
        path: the file, e.g. ``OUT/report.html``.

    Raises:
        InputError: ``path`` cannot be written.

    """
    write_text(path, report_html(calibration, rig))


def report_html(calibration: Calibration, rig: Rig) -> str:
    """The text of the report."""
    words = words_for(rig)
    sections = {
        "images": ("Camera images", camera_images(calibration, rig)),
        "cloud": ("Fused cloud", fused_view(calibration, rig)),
    }
    shown = {name: (title, content) for name, (title, content) in sections.items() if content}
    return Template(_part("page.html")).substitute(
        title=escaped(f"Calibration of {calibration.root} and {len(rig.sensors) - 1} more"),
        headline=escaped(headline(calibration)),
        facts=_facts(calibration, words),
        cards=cards(calibration, words) + remark_list(calibration) + suggestion_list(calibration),
        about_graph=words.graph,
        graph=graph(calibration, words),
        edges=edge_table(calibration, words),
        poses=pose_table(calibration) + estimated_table(calibration),
        about_residuals=words.residuals,
        residuals=histograms(calibration) + spreads(calibration, words) + left_out_table(calibration),
        view_title=words.view,
        about_view=words.about_view,
        view=floor_plan(calibration) if words is NETWORK else rig_view(calibration, rig),
        links="".join(f'<a href="#{name}">{title}</a>' for name, (title, _) in shown.items()),
        pictures="".join(
            f'<section id="{name}"><h2>{title}</h2>{content}</section>' for name, (title, content) in shown.items()
        ),
        coverage=coverages(calibration, rig, words),
        captures_title=words.rows,
        captures=captures(calibration, words) + gallery(calibration),
        style=_part("style.css"),
        plotly=get_plotlyjs(),
        script=_part("page.js"),
    )


def _part(name: str) -> str:
    return files("calgraph.report").joinpath(name).read_text(encoding="utf-8")


def _facts(calibration: Calibration, words: Words) -> str:
    count = len({row.capture for row in calibration.evidence.captures})
    facts = [f"root {calibration.root}", counted(count, words.row), f"estimator {calibration.evidence.estimator}"]
    return " · ".join(map(escaped, facts))

"""Thumbnails of each sensor's measurement in every capture, and the reason of each rejection."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.report.formatting import escape_html, format_fixed, format_length
from calgraph.report.thumbnails import render_thumbnail
from calgraph.result import Calibration, CaptureRow, Snapshot

# Largest number of thumbnails on the page, and captures that are initially expanded.
_MAX_IMAGES, _EXPANDED = 1000, 6


def render_gallery(calibration: Calibration) -> str:
    """A card for each capture with snapshots; empty where there are none."""
    taken = {(s.capture, s.sensor): s for s in calibration.pictures.snapshots}
    rows: dict[int, list[CaptureRow]] = {}
    for row in calibration.evidence.captures:
        rows.setdefault(row.capture, []).append(row)
    pictured = [capture for capture in rows if any((capture, row.sensor) in taken for row in rows[capture])]
    if not pictured:
        return ""
    each = max(len(rows[capture]) for capture in pictured)
    shown = pictured[:: len(pictured) * each // _MAX_IMAGES + 1]
    boards = {(view.capture, view.sensor): view.measured for view in calibration.pictures.board_views}
    cards = [_render_capture(capture, rows[capture], taken, boards) for capture in shown]
    some = "" if len(shown) == len(rows) else f" {len(shown)} of {len(rows)} captures are shown."
    rest = "".join(cards[_EXPANDED:])
    more = f"<details><summary>{len(cards) - _EXPANDED} more captures</summary>\
<div class='gallery'>{rest}</div></details>"
    return (
        f"<h3>Thumbnails</h3><p>Blue frames: used measurements; orange frames: rejected ones. Scans are drawn in "
        f"top view, clouds in azimuth and elevation; points detected as the board are orange.{some}</p>"
        f'<div class="gallery">{"".join(cards[:_EXPANDED])}</div>{more if rest else ""}'
    )


def _render_capture(
    capture: int,
    rows: Sequence[CaptureRow],
    taken: Mapping[tuple[int, str], Snapshot],
    boards: Mapping[tuple[int, str], Array],
) -> str:
    when = f"{format_fixed(rows[0].start, 1)} – {format_fixed(rows[0].end, 1)} s"
    thumbs = "".join(
        _render_snapshot(
            row, taken.get((capture, row.sensor)), boards.get((capture, row.sensor), np.empty((0, 3)))
        )
        for row in rows
    )
    return (
        f'<article class="capture"><h4>Capture {capture}<span>{when}</span></h4>'
        f'<div class="thumbs">{thumbs}</div></article>'
    )


def _render_snapshot(row: CaptureRow, taken: Snapshot | None, board: Array) -> str:
    url = render_thumbnail(taken, board) if taken else ""
    image = f'<img alt="" loading="lazy" src="{url}">' if url else ""
    outcome = "used" if row.used else "rejected"
    words = f"used{'' if row.residual is None else f', {format_length(row.residual)}'}" if row.used else row.reason
    return (
        f'<figure class="{outcome}"><div class="frame">{image}</div>'
        f"<figcaption><b>{escape_html(row.sensor)}</b>{escape_html(words)}</figcaption></figure>"
    )

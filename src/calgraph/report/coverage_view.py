"""The coverage of each sensor's field of view as a figure and as text."""

import numpy as np

from calgraph.config import Rig
from calgraph.report.coverage import Coverage, compute_coverage
from calgraph.report.formatting import KIND_NAMES, escape_html, format_count
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration

# Size of the drawing and of its margins for labels, px.
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _BELOW = 400, 230, 44, 16, 34
_TICKS = 5


def render_coverage(calibration: Calibration, rig: Rig, words: Vocabulary) -> str:
    """A figure for each sensor; a sentence where the result has no detections."""
    found = {sensor: compute_coverage(calibration, rig, sensor) for sensor in calibration.sensors}
    shown = "".join(
        f'<div class="cover"><h3>{escape_html(sensor.name)}</h3>{_render_picture(one, sensor.name, words)}'
        f"<ul>{''.join(f'<li>{escape_html(remark)}</li>' for remark in one.remarks)}</ul></div>"
        for sensor, one in found.items()
        if one
    )
    if not shown:
        return '<p class="empty">This result contains no detections.</p>'
    without = [escape_html(f"{s.name} ({KIND_NAMES[s.kind]})") for s, one in found.items() if not one]
    rest = f"<p>No detections: {', '.join(without)}.</p>" if without else ""
    return f'<p>{words.coverage_caption}</p><div class="grid">{shown}</div>{rest}'


def _render_picture(of: Coverage, name: str, words: Vocabulary) -> str:
    """The cells as an SVG, darker with more captures."""
    rows, columns = of.counts.shape
    width = _WIDTH - _LEFT - _RIGHT
    height = min(width * rows / columns, _HEIGHT) if of.axes[0] == "px" else 0.5 * _HEIGHT + 20
    w, h = width / columns, height / rows
    most = max(float(of.counts.max()), 1.0)
    cells = "".join(
        f'<rect class="cell" x="{_LEFT + j * w:.1f}" y="{8 + i * h:.1f}" width="{w:.1f}" height="{h:.1f}" '
        f'fill-opacity="{0.15 + 0.85 * np.log1p(n) / np.log1p(most):.2f}">'
        f"<title>{_format_bin(of.x_edges, j)} {of.axes[0]}, {_format_bin(of.y_edges, i)} {of.axes[1]}: "
        f"{format_count(int(n), words.item)}</title></rect>"
        for (i, j), n in np.ndenumerate(of.counts)
        if n
    )
    # Visible columns are grey; neighbouring ones are one rectangle, which avoids seams.
    turns = np.flatnonzero(np.diff(np.concatenate([[0], of.visible.astype(int), [0]]))).reshape(-1, 2)
    field = "".join(
        f'<rect class="field" x="{_LEFT + first * w:.1f}" y="8" width="{(last - first) * w:.1f}" '
        f'height="{height:.1f}"/>'
        for first, last in turns.tolist()
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {height + 8 + _BELOW:.0f}" role="img" '
        f'aria-label="Coverage of {escape_html(name)}">'
        f'<rect class="outside" x="{_LEFT}" y="8" width="{width}" height="{height:.1f}"/>{field}{cells}'
        f"{_render_labels(of, width, height)}</svg>"
    )


def _render_labels(of: Coverage, width: float, height: float) -> str:
    x = "".join(
        f'<text x="{_LEFT + t * width:.0f}" y="{height + 22:.0f}" text-anchor="middle">'
        f"{_format_tick(of.x_edges, t)}</text>"
        for t in np.linspace(0, 1, _TICKS)
    )
    y = "".join(
        f'<text x="{_LEFT - 6}" y="{12 + t * height:.0f}" text-anchor="end">{_format_tick(of.y_edges, t)}</text>'
        for t in (0.0, 0.5, 1.0)
    )
    names = "image, px" if of.axes[0] == "px" else f"across: {of.axes[0]}; up: {of.axes[1]}"
    return f'{x}{y}<text x="{_LEFT + width / 2:.0f}" y="{height + 38:.0f}" text-anchor="middle">{names}</text>'


def _format_tick(edges: np.ndarray[tuple[int], np.dtype[np.float64]], share: float) -> str:
    value = float(edges[0] + share * (edges[-1] - edges[0]))
    decimals = 0 if abs(edges[-1] - edges[0]) > 20 else 1
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def _format_bin(edges: np.ndarray[tuple[int], np.dtype[np.float64]], k: int) -> str:
    low, high = sorted((float(edges[k]), float(edges[k + 1])))
    return f"{low:.4g} to {high:.4g}".replace("-", "−")

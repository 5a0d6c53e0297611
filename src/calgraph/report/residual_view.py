"""Residuals: histograms of whitened residuals with the standard normal distribution, and distances by sensor."""

import numpy as np

from calgraph.geometry import Array
from calgraph.report.figures import BLUE, MUTED, RULE, VERMILION, Figure, escape_plotly, make_figure, render_figure
from calgraph.report.formatting import escape_html, format_count, format_significant
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration

# Range and bin width of the histograms, in standard deviations: 6e-7 of normal residuals are beyond.
_MAX_RESIDUAL = 5.0
_BIN_WIDTH = 0.25


def render_histograms(calibration: Calibration, words: Vocabulary) -> str:
    """One histogram of whitened residuals for each kind."""
    kinds = [(kind, np.ravel(values)) for kind, values in calibration.evidence.residuals.items()]
    if not any(np.isfinite(values).any() for _, values in kinds):
        return _render_rms(calibration)
    drawn = "".join(_render_histogram(i, *kind) for i, kind in enumerate(kinds))
    return f'<h3>Whitened residuals</h3><p>{words.residuals_caption}</p><div class="grid">{drawn}</div>'


def _render_rms(calibration: Calibration) -> str:
    if not calibration.evidence.residual_rms:
        return '<p class="empty">There are no residuals.</p>'
    values = ", ".join(
        f"{escape_html(kind)} {format_significant(rms, 3)}"
        for kind, rms in calibration.evidence.residual_rms.items()
    )
    return f'<p class="empty">Only the root mean squares of the residuals are available: {values}.</p>'


def _render_histogram(index: int, kind: str, values: Array) -> str:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return f'<div><h3>{escape_html(kind)}</h3><p class="empty">No finite residual.</p></div>'
    rms = float(np.sqrt(np.mean(finite**2)))
    facts = [format_count(finite.size, "residual"), f"RMS {format_significant(rms, 3)}"]
    beyond = int(np.sum(np.abs(finite) > _MAX_RESIDUAL))
    if beyond:
        facts.append(f"{beyond} beyond ±{_MAX_RESIDUAL:g}, in the outer bars")
    if finite.size < values.size:
        facts.append(f"{values.size - finite.size} not finite, left out")
    drawing = render_figure(
        f"residuals-{index}", _make_histogram(finite), 210, f"Histogram of the residuals {escape_html(kind)}"
    )
    return f"<div><h3>{escape_html(kind)}</h3><p class='facts'>{' · '.join(facts)}</p>{drawing}</div>"


def _make_histogram(values: Array) -> Figure:
    edges = np.arange(-_MAX_RESIDUAL, _MAX_RESIDUAL + _BIN_WIDTH / 2, _BIN_WIDTH)
    counts, _ = np.histogram(np.clip(values, -_MAX_RESIDUAL, _MAX_RESIDUAL), edges)
    centers = edges[:-1] + _BIN_WIDTH / 2
    x = np.linspace(-_MAX_RESIDUAL, _MAX_RESIDUAL, 101)
    normal = values.size * _BIN_WIDTH * np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    outer = np.abs(centers) > _MAX_RESIDUAL - _BIN_WIDTH
    colors = np.where(outer & (counts > 0), VERMILION, BLUE)
    bars = {
        "type": "bar", "x": centers, "y": counts, "width": _BIN_WIDTH,
        "marker": {"color": colors, "opacity": 0.75},
        "hovertemplate": "%{x:.2f} σ: %{y}<extra></extra>",
    }  # fmt: skip
    curve = {
        "type": "scatter", "mode": "lines", "x": x, "y": normal, "hoverinfo": "skip",
        "line": {"color": MUTED, "width": 1.5, "dash": "dot"},
    }  # fmt: skip
    axis = {"gridcolor": RULE, "zeroline": False, "fixedrange": True}
    return make_figure(
        [bars, curve],
        showlegend=False, bargap=0, margin={"l": 44, "r": 8, "t": 6, "b": 36},
        xaxis={**axis, "title": {"text": "residual / σ"},
               "range": [-_MAX_RESIDUAL - _BIN_WIDTH, _MAX_RESIDUAL + _BIN_WIDTH],
               "tickvals": [-4, -2, 0, 2, 4]},
        yaxis={**axis, "rangemode": "tozero"},
    )  # fmt: skip


def render_distances(calibration: Calibration, words: Vocabulary) -> str:
    """A box for each sensor with the distances of its captures or walks; empty where there are none."""
    distances: dict[str, list[float]] = {sensor.name: [] for sensor in calibration.sensors}
    for row in calibration.evidence.captures:
        if row.used and row.residual is not None and np.isfinite(row.residual):
            distances.setdefault(row.sensor, []).append(1e3 * row.residual)
    by_sensor = {name: values for name, values in distances.items() if values}
    if not by_sensor:
        return ""
    boxes = [
        {
            "type": "box", "x": np.array(values).round(3), "name": escape_plotly(name),
            "marker": {"color": BLUE, "size": 3}, "line": {"width": 1.5}, "boxpoints": "outliers",
            "hoverinfo": "x+name",
        }
        for name, values in by_sensor.items()
    ]  # fmt: skip
    drawing = make_figure(
        boxes,
        showlegend=False, margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={"title": {"text": "distance, mm"}, "gridcolor": RULE, "rangemode": "tozero", "fixedrange": True},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True},
    )  # fmt: skip
    chart = render_figure(
        "spreads", drawing, 70 + 34 * len(by_sensor), f"Distances of each {words.item} by sensor"
    )
    return f"<h3>Distances by sensor</h3><p>{words.distances_caption}</p>{chart}"

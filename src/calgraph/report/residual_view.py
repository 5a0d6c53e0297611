"""Residuals: whitened ones beside the normal distribution they should have, and distances by sensor."""

import numpy as np

from calgraph.geometry import Array
from calgraph.report.figures import BLUE, MUTED, RULE, VERMILION, Figure, figure, placed, plotly_text
from calgraph.report.formatting import counted, digits, escaped
from calgraph.report.vocabulary import Words
from calgraph.result import Calibration

_LIMIT = 5.0
_STEP = 0.25


def histograms(calibration: Calibration) -> str:
    """One histogram for each kind of residual."""
    kinds = [(kind, np.ravel(values)) for kind, values in calibration.evidence.residuals.items()]
    if not any(np.isfinite(values).any() for _, values in kinds):
        return _without_values(calibration)
    return '<div class="grid">' + "".join(_histogram(i, *kind) for i, kind in enumerate(kinds)) + "</div>"


def _without_values(calibration: Calibration) -> str:
    if not calibration.evidence.residual_rms:
        return '<p class="empty">There are no residuals.</p>'
    known = ", ".join(
        f"{escaped(kind)} {digits(rms, 3)}" for kind, rms in calibration.evidence.residual_rms.items()
    )
    return f'<p class="empty">Only the root mean squares of the residuals are known: {known}.</p>'


def _histogram(index: int, kind: str, values: Array) -> str:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return f'<div><h3>{escaped(kind)}</h3><p class="empty">No finite residual.</p></div>'
    rms = float(np.sqrt(np.mean(finite**2)))
    facts = [counted(finite.size, "residual"), f"RMS {digits(rms, 3)}"]
    beyond = int(np.sum(np.abs(finite) > _LIMIT))
    if beyond:
        facts.append(f"{beyond} beyond ±{_LIMIT:g}, in the outer bars")
    if finite.size < values.size:
        facts.append(f"{values.size - finite.size} not finite, left out")
    drawing = placed(f"residuals-{index}", _bars(finite), 210, f"Histogram of the residuals {escaped(kind)}")
    return f"<div><h3>{escaped(kind)}</h3><p class='facts'>{' · '.join(facts)}</p>{drawing}</div>"


def _bars(values: Array) -> Figure:
    edges = np.arange(-_LIMIT, _LIMIT + _STEP / 2, _STEP)
    counts, _ = np.histogram(np.clip(values, -_LIMIT, _LIMIT), edges)
    centers = edges[:-1] + _STEP / 2
    x = np.linspace(-_LIMIT, _LIMIT, 101)
    normal = values.size * _STEP * np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    outer = np.abs(centers) > _LIMIT - _STEP
    colors = np.where(outer & (counts > 0), VERMILION, BLUE)
    bars = {
        "type": "bar", "x": centers, "y": counts, "width": _STEP, "marker": {"color": colors, "opacity": 0.75},
        "hovertemplate": "%{x:.2f} σ: %{y}<extra></extra>",
    }  # fmt: skip
    curve = {
        "type": "scatter", "mode": "lines", "x": x, "y": normal, "hoverinfo": "skip",
        "line": {"color": MUTED, "width": 1.5, "dash": "dot"},
    }  # fmt: skip
    axis = {"gridcolor": RULE, "zeroline": False, "fixedrange": True}
    return figure(
        [bars, curve],
        showlegend=False, bargap=0, margin={"l": 44, "r": 8, "t": 6, "b": 36},
        xaxis={**axis, "title": {"text": "residual / σ"}, "range": [-_LIMIT - _STEP, _LIMIT + _STEP],
               "tickvals": [-4, -2, 0, 2, 4]},
        yaxis={**axis, "rangemode": "tozero"},
    )  # fmt: skip


def spreads(calibration: Calibration, words: Words) -> str:
    """A box for each sensor with the distances of its captures or walks; nothing where none is known."""
    distances: dict[str, list[float]] = {sensor.name: [] for sensor in calibration.sensors}
    for row in calibration.evidence.captures:
        if row.used and row.residual is not None and np.isfinite(row.residual):
            distances.setdefault(row.sensor, []).append(1e3 * row.residual)
    known = {name: values for name, values in distances.items() if values}
    if not known:
        return ""
    boxes = [
        {
            "type": "box", "x": np.array(values).round(3), "name": plotly_text(name),
            "marker": {"color": BLUE, "size": 3}, "line": {"width": 1.5}, "boxpoints": "outliers",
            "hoverinfo": "x+name",
        }
        for name, values in known.items()
    ]  # fmt: skip
    drawing = figure(
        boxes,
        showlegend=False, margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={"title": {"text": "distance, mm"}, "gridcolor": RULE, "rangemode": "tozero", "fixedrange": True},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True},
    )  # fmt: skip
    picture = placed("spreads", drawing, 70 + 34 * len(known), f"Distances of each {words.row} by sensor")
    return f"<h3>Distances by sensor</h3><p>{words.spread}</p>{picture}"

"""Plotly figures as plain mappings, and how they get into the page.

plotly.js is given its data as JSON; building that directly is as short as through plotly's Python classes. Colours
are those of style.css, by name: the page puts in what they are in the light, in the dark and on paper.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from calgraph.geometry import Array

Figure = dict[str, Any]
"""``data`` and ``layout`` of a plotly figure."""

BLUE, ORANGE, GREEN, VERMILION = "var(--blue)", "var(--orange)", "var(--green)", "var(--vermilion)"
PURPLE, BROWN, SKY, PINK = "var(--purple)", "var(--brown)", "var(--sky)", "var(--pink)"
INK, MUTED, RULE, NOTHING, PAPER = "var(--ink)", "var(--muted)", "var(--rule)", "var(--nothing)", "var(--paper)"
WHEEL = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, PURPLE, BROWN)
"""Colours of so many things that stay apart for every kind of colour blindness; of more, they come again."""

FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK}
_LAYOUT = {
    "font": FONT,
    "paper_bgcolor": PAPER,
    "plot_bgcolor": PAPER,
    "hoverlabel": {"align": "left", "bgcolor": PAPER, "bordercolor": RULE, "font": {"color": INK}},
}


def figure(data: list[dict[str, Any]], **layout: Any) -> Figure:
    """A figure in the page's style."""
    return {"data": data, "layout": _LAYOUT | layout}


def placed(name: str, content: Figure, height: int, description: str) -> str:
    """A figure's place on the page, with its data beside it.

    Args:
        name: id of the element; made of letters, digits and dashes.
        content: the figure.
        height: pixels.
        description: what it shows, for those who cannot see it; already escaped.

    """
    return (
        f'<div class="figure" id="{name}" style="height:{height}px" role="img" aria-label="{description}"></div>\n'
        f'<script type="application/json" class="figure-data" data-for="{name}">{_json(content)}</script>\n'
    )


def chooser(name: str, number: int, legend: str, labels: Sequence[str], chosen: int) -> str:
    """Buttons that change a figure, one of which is always chosen.

    Args:
        name: of the figure, whose ``choices[number]`` say for each button what it changes: which traces are
            ``visible`` (null: as they were), parts of the ``layout``, and ``moves`` (cos, sin, x, y) of what
            belongs together by ``meta``.
        number: of the choice, from 0.
        legend: what is chosen, for those who cannot see it.
        labels: of the buttons.
        chosen: which is chosen at first; the figure itself is as if none were.

    """
    buttons = "".join(
        f'<label><input type="radio" name="{name}-{number}" value="{k}"{" checked" if k == chosen else ""}>'
        f"<span>{label}</span></label>"
        for k, label in enumerate(labels)
    )
    return (
        f'<fieldset class="choice" data-for="{name}" data-of="{number}"><legend>{legend}</legend>'
        f"{buttons}</fieldset>\n"
    )


def plotly_text(text: str) -> str:
    """Any text for plotly, which understands some tags."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _json(content: Any) -> str:
    """JSON that may stand in a script element: no tag can begin in it."""
    text = json.dumps(_plain(content), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return _rounded(value)
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value


def _rounded(values: Array) -> Any:
    """Nested lists of numbers with six significant digits, None for those that are not finite."""
    finite = np.isfinite(values)
    size = np.floor(np.log10(np.abs(values), out=np.zeros(values.shape), where=finite & (values != 0)))
    step = 10.0 ** np.clip(5 - size, 0, 20)
    rounded = np.round(np.where(finite, values, 0.0) * step) / step
    nothing = np.full(values.shape, None, dtype=object)
    return np.where(finite, rounded.astype(object), nothing).tolist()

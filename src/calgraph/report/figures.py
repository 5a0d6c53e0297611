"""Plotly figures as plain mappings, and how they get into the page.

plotly.js is given its data as JSON; building that directly is as short as through plotly's Python classes.
"""

import json
from typing import Any

import numpy as np

Figure = dict[str, Any]
"""``data`` and ``layout`` of a plotly figure."""

# Okabe and Ito's colours, which stay apart for every kind of colour blindness.
BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
INK, MUTED, RULE, NOTHING = "#1f2933", "#5f6b7a", "#d9dee5", "#eef1f4"

FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK}
_LAYOUT = {"font": FONT, "paper_bgcolor": "#ffffff", "plot_bgcolor": "#ffffff", "hoverlabel": {"align": "left"}}


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
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value

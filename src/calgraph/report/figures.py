"""Plotly figures as plain mappings, and their embedding in the page.

plotly.js reads JSON; building it directly is as short as through plotly's Python classes. Colours are the
variables of style.css: the page substitutes their values for light mode, dark mode and print.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.geometry import Array
from calgraph.report.templates import render

Figure = dict[str, Any]
"""``data`` and ``layout`` of a plotly figure."""

BLUE, ORANGE, GREEN, VERMILION = "var(--blue)", "var(--orange)", "var(--green)", "var(--vermilion)"
PURPLE, BROWN, SKY, PINK = "var(--purple)", "var(--brown)", "var(--sky)", "var(--pink)"
INK, MUTED, RULE, NO_DATA, PAPER = "var(--ink)", "var(--muted)", "var(--rule)", "var(--nothing)", "var(--paper)"
COLOR_CYCLE = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, PURPLE, BROWN)
"""Colours that are distinguishable for every kind of colour blindness; repeated for more than eight items."""

SCENE_AXIS = {"backgroundcolor": PAPER, "gridcolor": RULE, "zerolinecolor": RULE, "showspikes": False}
"""Style of the axes of 3-D scenes."""
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK}
_BASE_LAYOUT = {
    "font": FONT,
    "paper_bgcolor": PAPER,
    "plot_bgcolor": PAPER,
    "hoverlabel": {"align": "left", "bgcolor": PAPER, "bordercolor": RULE, "font": {"color": INK}},
}


def choose_enlargement(size: float, min_visible: float) -> int:
    """Smallest round factor that enlarges ``size`` to ``min_visible``; 1000 at most."""
    factors = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
    return next((f for f in factors if f * size >= min_visible), factors[-1])


def make_figure(data: list[dict[str, Any]], **layout: Any) -> Figure:
    """A figure in the page's style."""
    return {"data": data, "layout": _BASE_LAYOUT | layout}


@dataclass(frozen=True)
class Chooser:
    """Radio buttons that change a figure."""

    legend: str
    """For screen readers."""
    choices: Mapping[str, Mapping[str, Any]]
    """By label what changes: which traces are ``visible`` (null: unchanged), parts of the ``layout``, and
    ``moves`` (cos, sin, x, y) of the traces with one ``meta``."""
    chosen: int
    """The initial button; the figure itself is without the changes of any."""


def render_figure(
    name: str,
    content: Figure,
    height: int,
    description: str,
    choosers: Sequence[Chooser] = (),
    caption: str = "",
    key: Sequence[tuple[str, str]] = (),
) -> Markup:
    """HTML of a figure, with its data as JSON.

    Args:
        name: id of the element; made of letters, digits and dashes.
        content: the figure.
        height: pixels.
        description: for screen readers.
        choosers: buttons above the figure.
        caption: above the buttons.
        key: names and colours that stand above the figure on narrow screens, where they replace its legend.
    """
    if choosers:
        content = content | {"choices": [list(chooser.choices.values()) for chooser in choosers]}
    return render(
        "figure.html", name=name, content=_to_json(content), height=height, description=description,
        choosers=choosers, caption=caption, key=[(Markup(label), color) for label, color in key],
    )  # fmt: skip


def escape_plotly(text: str) -> str:
    """Escapes text for plotly, which interprets some tags."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _to_json(content: Any) -> Markup:
    """JSON that is safe inside a script element: it contains no tag."""
    text = json.dumps(_to_plain(content), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def _to_plain(value: Any) -> Any:
    # Strings and numbers are the most frequent values, so they are tested first.
    if isinstance(value, str | int) or value is None:
        return value
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _to_plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return _round_significant(value)
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuU":
        return value.tolist()
    if isinstance(value, list | tuple | np.ndarray):
        return [_to_plain(item) for item in value]
    return _to_plain(value.item()) if isinstance(value, np.generic) else value


def _round_significant(values: Array) -> Any:
    """Nested lists of numbers with six significant digits, None where they are not finite."""
    finite = np.isfinite(values)
    size = np.floor(np.log10(np.abs(values), out=np.zeros(values.shape), where=finite & (values != 0)))
    step = 10.0 ** np.clip(5 - size, 0, 20)
    rounded = np.round(np.where(finite, values, 0.0) * step) / step
    missing = np.full(values.shape, None, dtype=object)
    return np.where(finite, rounded.astype(object), missing).tolist()

"""Extensions of Sphinx: formulas without scripts, readable signatures, figures, lists of the source.

Formulas become MathML while the site is built, and plotly's script is part of the site: pages work offline.
"""

from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from message_list import message_list
from plotly.offline import get_plotlyjs
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

from calgraph.config.settings_tables import settings_tables

_SCRIPT = "plotly.min.js"
_SHOWN = "figure"
"""Examples show what they drew by ending a block in this name."""
_FIELDS = ("attribute", "data", "property")
_READ_FROM_SOURCE = {"messages": message_list, "settings": settings_tables}
"""What pages end with, as Markdown."""
_COLON = "\ue000"
"""Stands for a colon, from the range of characters that mean nothing."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers everything with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline_formula, None), (_formula, None))
    app.connect("autodoc-process-signature", _fields_say_it)
    app.connect("autodoc-process-docstring", _colons_hidden, priority=400)
    app.connect("autodoc-process-docstring", _colons_back, priority=600)
    app.connect("source-read", _add_tables)
    app.connect("build-finished", _write_script)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline_formula(writer: HTML5Translator, node: nodes.math) -> None:
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _formula(writer: HTML5Translator, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="formula">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def _fields_say_it(
    _app: Sphinx, _what: str, _name: str, documented: Any, _options: Any, signature: str, returned: str
) -> tuple[str, str]:
    """No signature for classes that are made of their fields, which are listed below it with their types."""
    fields = isinstance(documented, type) and (is_dataclass(documented) or hasattr(documented, "model_fields"))
    return ("", "") if fields else (signature, returned)


def _colons_hidden(_app: Sphinx, what: str, _name: str, _of: Any, _options: Any, lines: list[str]) -> None:
    """Keeps napoleon, which comes next, from taking what is before a colon in a field's docstring for its type."""
    if what in _FIELDS:
        lines[:] = [line.replace(":", _COLON) for line in lines]


def _colons_back(_app: Sphinx, what: str, _name: str, _of: Any, _options: Any, lines: list[str]) -> None:
    if what in _FIELDS:
        lines[:] = [line.replace(_COLON, ":") for line in lines]


def _add_tables(_app: Sphinx, page: str, source: list[str]) -> None:
    if page in _READ_FROM_SOURCE:
        source[0] += f"\n{_READ_FROM_SOURCE[page]()}\n"


def _write_script(app: Sphinx, error: Exception | None) -> None:
    if error is None:
        (Path(app.outdir) / "_static" / _SCRIPT).write_text(get_plotlyjs(), encoding="utf-8")


def figure_scraper(block: Any, block_vars: dict[str, Any], _gallery_conf: dict[str, Any]) -> str:
    """The reStructuredText that shows the figure with which a block of an example ends; empty for other blocks."""
    figure = block_vars["example_globals"].get(_SHOWN)
    if not isinstance(figure, go.Figure) or block[1].strip().splitlines()[-1] != _SHOWN:
        return ""
    script = f"../_static/{_SCRIPT}"
    html = figure.to_html(full_html=False, include_plotlyjs=script, config={"displayModeBar": False})
    indented = "\n".join(f"    {line}" for line in html.splitlines())
    return f"\n.. raw:: html\n\n{indented}\n\n"

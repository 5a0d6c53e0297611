"""What became of each capture in each sensor, or of each walk: a picture at a glance, and a table to search in."""

from collections import Counter

import numpy as np

from calgraph.report.figures import BLUE, NOTHING, ORANGE, Figure, figure, placed, plotly_text
from calgraph.report.formatting import counted, escaped, fixed, length
from calgraph.report.vocabulary import NETWORK, Words
from calgraph.report.walk_view import timeline
from calgraph.result import Calibration, CaptureRow

_ABSENT, _REJECTED, _USED = 0, 1, 2
# Rows at most in the picture and in the table: a browser gets slow, and the page large, with many more.
_MOST = 6000


def captures(calibration: Calibration, words: Words) -> str:
    """All of it; a sentence where there are none."""
    rows = calibration.evidence.captures
    if not rows:
        return f'<p class="empty">{words.no_rows}</p>'
    names = _names(calibration)
    count = counted(len({row.capture for row in rows}), words.row)
    about, absent = words.key
    shown = rows[:: len(rows) // _MOST + 1]
    if len(shown) < len(rows):
        about += f" Shown are {len(shown)} of {len(rows)} rows; captures.csv has them all."
    draw = timeline if words is NETWORK else _matrix
    picture = placed(
        "captures", draw(shown, names), 84 + 26 * len(names), f"Outcome of each {words.row} in each sensor"
    )
    swatches = {"used": "used", "rejected": "not used"} | ({"absent": absent} if absent else {})
    key = " ".join(f'<span class="swatch {css}"></span>{meaning}' for css, meaning in swatches.items())
    return (
        f"<p>{count}. {about}</p>"
        f'<p class="key">{key}</p>'
        f"{picture}{_reasons(rows, names)}{_table(shown, names, words.row)}"
    )


def _names(calibration: Calibration) -> list[str]:
    """The sensors in the order of the page, then those that only captures or the unconnected name."""
    known = [s.name for s in calibration.sensors]
    return list(
        dict.fromkeys(
            [*known, *calibration.evidence.unconnected, *(row.sensor for row in calibration.evidence.captures)]
        )
    )


def _matrix(rows: tuple[CaptureRow, ...], names: list[str]) -> Figure:
    numbers = sorted({row.capture for row in rows})
    column = {number: i for i, number in enumerate(numbers)}
    line = {name: i for i, name in enumerate(names)}
    outcome = np.full((len(names), len(numbers)), _ABSENT)
    words = [[f"<b>{plotly_text(name)}</b>, capture {n}<br>no measurement" for n in numbers] for name in names]
    for row in rows:
        i, j = line[row.sensor], column[row.capture]
        outcome[i, j] = _USED if row.used else _REJECTED
        words[i][j] = _hover_text(row)
    colors = [[0, NOTHING], [1 / 3, NOTHING], [1 / 3, ORANGE], [2 / 3, ORANGE], [2 / 3, BLUE], [1, BLUE]]
    cells = {
        "type": "heatmap", "z": outcome, "zmin": -0.5, "zmax": 2.5, "colorscale": colors, "showscale": False,
        "x": [str(n) for n in numbers], "y": [plotly_text(name) for name in names], "text": words,
        "hovertemplate": "%{text}<extra></extra>", "xgap": 1, "ygap": 2,
    }  # fmt: skip
    return figure(
        [cells],
        margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={
            "title": {"text": "capture"},
            "type": "category",
            "fixedrange": True,
            "showgrid": False,
            "nticks": 12,
        },
        yaxis={
            "autorange": "reversed",
            "type": "category",
            "automargin": True,
            "fixedrange": True,
            "showgrid": False,
        },
    )


def _hover_text(row: CaptureRow) -> str:
    when = f"{fixed(row.start, 1)} – {fixed(row.end, 1)} s"
    if row.used:
        outcome = "used" if row.residual is None else f"used, residual {length(row.residual)}"
    else:
        outcome = f"not used: {_wrapped(row.reason)}"
    return f"<b>{plotly_text(row.sensor)}</b>, capture {row.capture}, {when}<br>{outcome}"


def _wrapped(text: str, width: int = 60) -> str:
    """Lines of words, as plotly's hover labels do not wrap."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(map(plotly_text, lines))


def _reasons(rows: tuple[CaptureRow, ...], names: list[str]) -> str:
    """For each sensor how many captures were used, and the commonest reasons why others were not."""
    body = ""
    for name in names:
        own = [row for row in rows if row.sensor == name]
        used = sum(row.used for row in own)
        common = Counter(row.reason or "no reason given" for row in own if not row.used).most_common(3)
        why = "; ".join(f"{escaped(reason)} ({count})" for reason, count in common)
        share = round(100 * used / len(own)) if own else 0
        body += (
            f"<tr><th scope='row'>{escaped(name)}</th><td>{used} of {len(own)}</td>"
            f"<td><span class='bar'><span style='width:{share}%'></span></span></td>"
            f"<td class='words'>{why}</td></tr>"
        )
    return (
        '<div class="wide"><table><thead><tr><th>sensor</th><th>used</th><th></th>'
        f"<th class='words'>commonest reasons why not</th></tr></thead><tbody>{body}</tbody></table></div>"
    )


def _table(rows: tuple[CaptureRow, ...], names: list[str], noun: str) -> str:
    body = "".join(_table_row(row) for row in rows)
    sensors = "".join(f'<option value="{escaped(name)}">{escaped(name)}</option>' for name in names)
    return f"""\
<div class="filters" role="search">
<label>sensor <select id="filter-sensor"><option value="">all</option>{sensors}</select></label>
<label>outcome <select id="filter-outcome"><option value="">all</option><option value="used">used</option>\
<option value="not used">not used</option></select></label>
<label>search <input id="filter-text" type="search" placeholder="reason, {noun}"></label>
<output id="filter-count"></output>
</div>
<div class="tall"><table id="capture-table"><thead><tr><th>{noun}</th><th>start, s</th><th>end, s</th>\
<th class="words">sensor</th><th class="words">outcome</th><th>residual</th><th class="words">reason</th></tr>\
</thead>\
<tbody>{body}</tbody></table></div>
"""


def _table_row(row: CaptureRow) -> str:
    outcome = "used" if row.used else "not used"
    residual = "" if row.residual is None else length(row.residual)
    return (
        f'<tr data-sensor="{escaped(row.sensor)}" data-outcome="{outcome}"><td>{row.capture}</td>'
        f"<td>{fixed(row.start, 2)}</td><td>{fixed(row.end, 2)}</td><td class='words'>{escaped(row.sensor)}</td>"
        f"<td class='words outcome {'used' if row.used else 'rejected'}'>{outcome}</td><td>{residual}</td>"
        f"<td class='words'>{escaped(row.reason)}</td></tr>\n"
    )

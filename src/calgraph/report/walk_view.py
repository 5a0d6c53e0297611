"""Timeline of the tracks of each scanner of a network, and whether another scanner tracked the same person."""

from collections.abc import Sequence

import numpy as np

from calgraph.report.figures import BLUE, ORANGE, RULE, Figure, escape_plotly, make_figure
from calgraph.report.formatting import format_fixed, format_length
from calgraph.result import CaptureRow

# Simultaneous walks are drawn in lanes, offsets from the middle of a scanner's row.
_LANES = (0.0, -0.16, 0.16, -0.32, 0.32)


def walk_timeline(rows: Sequence[CaptureRow], names: Sequence[str]) -> Figure:
    """A row for each scanner, a line for each walk: blue where it was used, orange where it was not."""
    height = _assign_lanes(rows, names)
    traces = []
    for used, color in ((True, BLUE), (False, ORANGE)):
        x: list[float | None] = []
        y: list[float | None] = []
        words: list[str | None] = []
        for row, at in zip(rows, height, strict=True):
            if row.used == used:
                x += [row.start, row.end, None]
                y += [at, at, None]
                words += [_hover_text(row), _hover_text(row), None]
        traces.append({
            "type": "scatter", "mode": "lines+markers", "x": x, "y": y, "text": words,
            "line": {"color": color, "width": 3}, "marker": {"color": color, "size": 4},
            "hovertemplate": "%{text}<extra></extra>",
        })  # fmt: skip
    return make_figure(
        traces,
        showlegend=False,
        hovermode="closest",
        margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={"title": {"text": "time from the start of the recording, s"}, "gridcolor": RULE, "zeroline": False},
        yaxis={
            "tickvals": list(range(len(names))),
            "ticktext": [escape_plotly(name) for name in names],
            "range": [len(names) - 0.5, -0.5],
            "automargin": True,
            "fixedrange": True,
            "showgrid": False,
            "zeroline": False,
        },
    )


def _assign_lanes(rows: Sequence[CaptureRow], names: Sequence[str]) -> list[float]:
    """Height of each row's line: its scanner's number, in the first free lane."""
    free = {name: np.full(len(_LANES), -np.inf) for name in names}
    heights = []
    for row in rows:
        lanes = free[row.sensor]
        lane = int(np.argmax(lanes <= row.start)) if (lanes <= row.start).any() else int(np.argmin(lanes))
        lanes[lane] = row.end
        heights.append(list(names).index(row.sensor) + _LANES[lane])
    return heights


def _hover_text(row: CaptureRow) -> str:
    when = f"{format_fixed(row.start, 1)} – {format_fixed(row.end, 1)} s"
    off = "" if row.residual is None else f", {format_length(row.residual)} apart"
    outcome = f"also tracked by another scanner{off}" if row.used else escape_plotly(row.reason)
    return f"<b>{escape_plotly(row.sensor)}</b>, walk {row.capture}, {when}<br>{outcome}"

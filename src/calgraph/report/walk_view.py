"""When each scanner of a network followed somebody, and whether another scanner saw the same walk."""

from collections.abc import Sequence

import numpy as np

from calgraph.report.figures import BLUE, ORANGE, RULE, Figure, figure, plotly_text
from calgraph.report.formatting import fixed, length
from calgraph.result import CaptureRow

# Walks at the same time lie side by side in lanes, parts of a scanner's row away from its middle.
_LANES = (0.0, -0.16, 0.16, -0.32, 0.32)


def timeline(rows: Sequence[CaptureRow], names: Sequence[str]) -> Figure:
    """A row for each scanner, a line for each walk: blue where it was used, orange where it was not."""
    height = _heights(rows, names)
    traces = []
    for used, color in ((True, BLUE), (False, ORANGE)):
        x: list[float | None] = []
        y: list[float | None] = []
        words: list[str | None] = []
        for row, at in zip(rows, height, strict=True):
            if row.used == used:
                x += [row.start, row.end, None]
                y += [at, at, None]
                words += [_hover(row), _hover(row), None]
        traces.append({
            "type": "scatter", "mode": "lines+markers", "x": x, "y": y, "text": words,
            "line": {"color": color, "width": 3}, "marker": {"color": color, "size": 4},
            "hovertemplate": "%{text}<extra></extra>",
        })  # fmt: skip
    return figure(
        traces,
        showlegend=False,
        hovermode="closest",
        margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={"title": {"text": "time from the start of the recording, s"}, "gridcolor": RULE, "zeroline": False},
        yaxis={
            "tickvals": list(range(len(names))),
            "ticktext": [plotly_text(name) for name in names],
            "range": [len(names) - 0.5, -0.5],
            "automargin": True,
            "fixedrange": True,
            "showgrid": False,
            "zeroline": False,
        },
    )


def _heights(rows: Sequence[CaptureRow], names: Sequence[str]) -> list[float]:
    """Where each row's line lies: its scanner's number, in the first lane that is free again."""
    free = {name: np.full(len(_LANES), -np.inf) for name in names}
    heights = []
    for row in rows:
        own = free[row.sensor]
        lane = int(np.argmax(own <= row.start)) if (own <= row.start).any() else int(np.argmin(own))
        own[lane] = row.end
        heights.append(list(names).index(row.sensor) + _LANES[lane])
    return heights


def _hover(row: CaptureRow) -> str:
    when = f"{fixed(row.start, 1)} – {fixed(row.end, 1)} s"
    off = "" if row.residual is None else f", {length(row.residual)} apart"
    outcome = f"also seen by another scanner{off}" if row.used else plotly_text(row.reason)
    return f"<b>{plotly_text(row.sensor)}</b>, walk {row.capture}, {when}<br>{outcome}"

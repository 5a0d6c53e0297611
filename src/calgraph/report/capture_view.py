"""Outcome of each capture in each sensor, or of each walk: a figure, and a searchable table."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from textwrap import wrap

import numpy as np
from markupsafe import Markup

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import BLUE, NO_DATA, ORANGE, RULE, Figure, escape_plotly, make_figure, render_figure
from calgraph.report.formatting import format_fixed, format_length
from calgraph.report.templates import render
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, CaptureRow
from calgraph.result.calibrated_cameras import calibrated_cameras
from calgraph.sensors.kinds import KINDS

_ABSENT, _REJECTED, _USED = 0, 1, 2
_NUMBER = re.compile(r"[-−]?\d+(\.\d+)?")
# Largest number of rows in the figure and in the table: browsers get slow with many more.
_MAX_ROWS = 6000
# Characters of a line of a hover label.
_LABEL_WIDTH = 60


def render_captures(calibration: Calibration, rig: Rig, words: Vocabulary) -> Markup:
    """Figure, reasons and table; a sentence where there are no captures."""
    rows = calibration.evidence.captures
    if not rows:
        return Markup('<p class="empty">{}</p>').format(words.no_items)
    names = _ordered_names(calibration)
    shown = rows[:: len(rows) // _MAX_ROWS + 1]
    outside = _find_outside(calibration, rig)
    walks = words.item == "walk"
    drawing = walk_timeline(shown, names) if walks else _outcome_matrix(shown, names, outside)
    return render(
        "captures.html",
        words=words,
        count=len({row.capture for row in rows}),
        total=len(rows),
        shown=shown,
        sensors=[_count_outcomes(name, rows, outside) for name in names],
        figure=render_figure(
            "captures", drawing, 84 + 26 * len(names), f"Outcome of each {words.item} in each sensor"
        ),
    )


def _ordered_names(calibration: Calibration) -> list[str]:
    """The sensors in the order of the page, then those that occur only in captures or are unconnected."""
    names = [s.name for s in calibration.sensors]
    return list(
        dict.fromkeys(
            [*names, *calibration.evidence.unconnected, *(row.sensor for row in calibration.evidence.captures)]
        )
    )


_Outside = Callable[[CaptureRow], bool]
"""Whether the board was out of a sensor's view."""


def _find_outside(calibration: Calibration, rig: Rig) -> _Outside:
    """By the final poses: no corner of the board is in the image, or all are on one side of the scan plane."""
    boards: dict[int, list[Array]] = {}
    for outline in calibration.pictures.board_outlines:
        boards.setdefault(outline.capture, []).append(outline.corners)
    sensors = {sensor.name: sensor for sensor in calibration.sensors}
    cameras = calibrated_cameras(calibration, rig)

    def is_outside(row: CaptureRow) -> bool:
        if row.used or row.sensor not in sensors or row.capture not in boards:
            return False
        sensor = sensors[row.sensor]
        corners = se3.apply(se3.inverse(sensor.T_root_sensor), np.array(boards[row.capture]))
        if row.sensor in cameras:
            camera = cameras[row.sensor]
            return not camera.contains(camera.project(corners.reshape(-1, 3))).any()
        above = corners[..., 2] > 0
        return KINDS[sensor.kind].shape == "disc" and bool((above.all(axis=1) | ~above.any(axis=1)).all())

    return is_outside


def _outcome_matrix(rows: tuple[CaptureRow, ...], names: list[str], outside: _Outside) -> Figure:
    numbers = sorted({row.capture for row in rows})
    column = {number: i for i, number in enumerate(numbers)}
    line = {name: i for i, name in enumerate(names)}
    outcome = np.full((len(names), len(numbers)), _ABSENT)
    words = [[f"<b>{escape_plotly(name)}</b>, capture {n}<br>no measurement" for n in numbers] for name in names]
    for row in rows:
        i, j = line[row.sensor], column[row.capture]
        outcome[i, j] = _USED if row.used else _ABSENT if outside(row) else _REJECTED
        words[i][j] = _hover_text(row) + ("<br>the board was not in its view" if outside(row) else "")
    colors = [[0, NO_DATA], [1 / 3, NO_DATA], [1 / 3, ORANGE], [2 / 3, ORANGE], [2 / 3, BLUE], [1, BLUE]]
    cells = {
        "type": "heatmap", "z": outcome, "zmin": -0.5, "zmax": 2.5, "colorscale": colors, "showscale": False,
        "x": [str(n) for n in numbers], "y": [escape_plotly(name) for name in names], "text": words,
        "hovertemplate": "%{text}<extra></extra>", "xgap": 1, "ygap": 2,
    }  # fmt: skip
    return make_figure(
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
    when = f"{format_fixed(row.start, 1)} – {format_fixed(row.end, 1)} s"
    if row.used:
        outcome = "used" if row.residual is None else f"used, residual {format_length(row.residual)}"
    else:
        outcome = f"not used: {_wrap_text(row.reason)}"
    return f"<b>{escape_plotly(row.sensor)}</b>, capture {row.capture}, {when}<br>{outcome}"


def _wrap_text(text: str) -> str:
    """Wraps text, as plotly's hover labels do not."""
    lines = wrap(text, _LABEL_WIDTH, break_long_words=False, break_on_hyphens=False)
    return "<br>".join(map(escape_plotly, lines))


def _count_outcomes(
    name: str, rows: Sequence[CaptureRow], outside: _Outside
) -> tuple[str, int, int, list[tuple[str, int]]]:
    """Of one sensor: name, numbers of used and of all captures, and the most frequent reasons of rejections.

    Reasons that differ in numbers only are one.
    """
    of_sensor = [row for row in rows if row.sensor == name]
    reasons: dict[str, list[str]] = {}
    for row in of_sensor:
        if not row.used:
            reason = "the board was not in its view" if outside(row) else row.reason or "no reason given"
            reasons.setdefault(_NUMBER.sub("…", reason), []).append(reason)
    common = Counter({
        each[0] if len(set(each)) == 1 else general: len(each) for general, each in reasons.items()
    }).most_common(4)  # fmt: skip
    return name, sum(row.used for row in of_sensor), len(of_sensor), common


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
                words += [_describe_walk(row), _describe_walk(row), None]
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


def _describe_walk(row: CaptureRow) -> str:
    when = f"{format_fixed(row.start, 1)} – {format_fixed(row.end, 1)} s"
    off = "" if row.residual is None else f", {format_length(row.residual)} apart"
    outcome = f"also tracked by another sensor{off}" if row.used else escape_plotly(row.reason)
    return f"<b>{escape_plotly(row.sensor)}</b>, walk {row.capture}, {when}<br>{outcome}"

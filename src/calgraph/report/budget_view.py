"""The shares of the sources of errors in the variances of poses, as bars."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from calgraph.report.figures import COLOR_CYCLE, MUTED, PAPER, Figure, escape_plotly, make_figure, render_figure
from calgraph.report.formatting import format_angle, format_count, format_length
from calgraph.result import Calibration, ErrorBudget, SensorPose
from calgraph.sensors.kinds import KINDS

# With more sensors than these, the least certain ones, the figure would be longer than two screens.
_MAX_SENSORS = 20
# Sources of smaller shares are one segment: theirs would be narrower than ten pixels.
_MIN_SHARE = 0.01
# A source with a larger share is named in its segment, if the name fits.
_MIN_LABELLED_SHARE = 0.15
_OTHERS = "others"


def render_budget(calibration: Calibration) -> Markup:
    """Two bars for each sensor, along its worst axis and about it; empty without a budget."""
    budget = calibration.budget
    sensors = [(k, sensor) for k, sensor in enumerate(calibration.sensors) if sensor.parent is not None]
    if budget is None or not sensors:
        return Markup()
    shown = sorted(sensors, key=lambda one: -one[1].worst_stddev[0])[:_MAX_SENSORS]
    segments = [segment for k, sensor in shown for segment in _split_variances(budget, k, sensor)]
    caption = (
        "Shares of the variance along and about the axes of each sensor with the largest σ, by what the errors "
        "come from. Variances add up: a source of 75\u00a0% doubles σ, one of 10\u00a0% adds 5\u00a0% to it."
    )
    if len(shown) < len(sensors):
        caption += f" The {len(shown)} least certain of {len(sensors)} sensors are shown; inspect has all."
    description = "Shares of the sources of errors in the variances of the poses"
    drawn = _draw(segments)
    key = [(trace["name"], trace["marker"]["color"]) for trace in drawn["data"]]
    return render_figure("budget-shares", drawn, 90 + 80 * len(shown), description, caption=caption, key=key)


@dataclass(frozen=True)
class _Segment:
    """A part of a bar."""

    bar: str
    """Label of the bar."""
    kind: str
    """Of the source."""
    name: str
    """Of the source."""
    stddev: str
    start: float
    share: float
    remedy: str = ""

    @property
    def hover(self) -> str:
        remedy = f"<br>smaller by {self.remedy}" if self.remedy else ""
        return f"{escape_plotly(self.name)}<br>σ {self.stddev}, {100 * self.share:.2g} % of the variance{remedy}"


def _split_variances(budget: ErrorBudget, index: int, sensor: SensorPose) -> Iterator[_Segment]:
    """The segments of both bars of a sensor, the largest first."""
    for first, format_stddev in ((0, format_length), (3, format_angle)):
        axis = first + int(np.argmax(sensor.axis_stddev[first : first + 3]))
        sigma = format_stddev(float(sensor.axis_stddev[axis]))
        bar = f"<b>{escape_plotly(sensor.name)}</b><br>{KINDS[sensor.kind].axes[axis]}, σ {sigma}"
        sources = budget.largest(index, axis)
        large = [one for one in sources if one[2] >= _MIN_SHARE]
        start = 0.0
        for source, stddev, share in large:
            yield _Segment(bar, source.kind, str(source), format_stddev(stddev), start, share, source.remedy)
            start += share
        if rest := sources[len(large) :]:
            stddev = float(np.linalg.norm([one[1] for one in rest]))
            name = format_count(len(rest), "other source")
            yield _Segment(bar, _OTHERS, name, format_stddev(stddev), start, sum(one[2] for one in rest))


def _draw(segments: Sequence[_Segment]) -> Figure:
    """Bars in the colours of the kinds of sources, of which those with the smallest shares have one together."""
    totals: defaultdict[str, float] = defaultdict(float)
    for one in segments:
        totals[one.kind] += one.share
    ranked = [kind for kind in sorted(totals, key=lambda kind: -totals[kind]) if kind != _OTHERS]
    colors = dict(zip(ranked, COLOR_CYCLE, strict=False)) | {_OTHERS: MUTED}
    data = []
    for kind, color in colors.items():
        parts = [one for one in segments if one.kind == kind or (kind == _OTHERS and one.kind not in colors)]
        if not parts:
            continue
        data.append({
            "type": "bar", "orientation": "h", "name": escape_plotly(kind), "y": [one.bar for one in parts],
            "base": [100 * one.start for one in parts], "x": [100 * one.share for one in parts],
            "text": [escape_plotly(one.name) if one.share > _MIN_LABELLED_SHARE else "" for one in parts],
            "textposition": "inside", "insidetextanchor": "middle", "textangle": 0,
            "customdata": [one.hover for one in parts], "hovertemplate": "%{customdata}<extra></extra>",
            "marker": {"color": color, "line": {"color": PAPER, "width": 1}},
        })  # fmt: skip
    return make_figure(
        data,
        barmode="overlay", bargap=0.25, margin={"l": 10, "r": 20, "t": 40, "b": 30},
        uniformtext={"mode": "hide", "minsize": 11}, legend={"orientation": "h", "y": 1, "yanchor": "bottom"},
        xaxis={"range": [0, 100], "ticksuffix": " %", "showgrid": False, "zeroline": False, "fixedrange": True},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True,
               "ticks": "outside", "tickcolor": PAPER},
    )  # fmt: skip

"""Residuals: histograms of whitened residuals with the standard normal distribution, and distances by sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.config import Rig
from calgraph.geometry import STDDEV_PER_MAD, Array
from calgraph.report.figures import (
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    PINK,
    RULE,
    VERMILION,
    Figure,
    choose_enlargement,
    escape_plotly,
    make_figure,
    render_figure,
)
from calgraph.report.formatting import format_count, format_significant
from calgraph.report.templates import render
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, SensorPose
from calgraph.result.calibrated_cameras import calibrated_cameras
from calgraph.result.evidence import format_error
from calgraph.result.residuals_file import capture_times
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS
from calgraph.surfaces.placed_points import find_incidence

# Range and bin width of the histograms, in standard deviations: 6e-7 of normal residuals are beyond.
_MAX_RESIDUAL = 5.0
_BIN_WIDTH = 0.25


def render_residuals(calibration: Calibration, words: Vocabulary) -> Markup:
    """A histogram of whitened residuals for each kind, and for each sensor a box of its captures' distances."""
    return render(
        "histograms.html",
        calibration=calibration,
        words=words,
        histograms=[
            _describe_histogram(i, *kind) for i, kind in enumerate(calibration.evidence.residuals.items())
        ],
        distances=_render_distances(calibration, words),
    )


def _describe_histogram(index: int, kind: str, residuals: Array) -> dict[str, Any]:
    values = np.ravel(residuals)
    finite = values[np.isfinite(values)]
    if not finite.size:
        return {"kind": kind, "figure": ""}
    rms = float(np.sqrt(np.mean(finite**2)))
    facts = [format_count(finite.size, "residual"), f"RMS {format_significant(rms, 3)}"]
    beyond = int(np.sum(np.abs(finite) > _MAX_RESIDUAL))
    if beyond:
        facts.append(f"{beyond} beyond ±{_MAX_RESIDUAL:g}, in the outer bars")
    if finite.size < values.size:
        facts.append(f"{values.size - finite.size} not finite, left out")
    figure = render_figure(
        f"residuals-{index}", _make_histogram(finite), 210, f"Histogram of the residuals {kind}"
    )
    return {"kind": kind, "facts": facts, "figure": figure}


def _make_histogram(values: Array) -> Figure:
    edges = np.arange(-_MAX_RESIDUAL, _MAX_RESIDUAL + _BIN_WIDTH / 2, _BIN_WIDTH)
    counts, _ = np.histogram(np.clip(values, -_MAX_RESIDUAL, _MAX_RESIDUAL), edges)
    centers = edges[:-1] + _BIN_WIDTH / 2
    x = np.linspace(-_MAX_RESIDUAL, _MAX_RESIDUAL, 101)
    normal = values.size * _BIN_WIDTH * np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    outer = np.abs(centers) > _MAX_RESIDUAL - _BIN_WIDTH
    colors = np.where(outer & (counts > 0), VERMILION, BLUE)
    bars = {
        "type": "bar", "x": centers, "y": counts, "width": _BIN_WIDTH,
        "marker": {"color": colors, "opacity": 0.75},
        "hovertemplate": "%{x:.2f} σ: %{y}<extra></extra>",
    }  # fmt: skip
    curve = {
        "type": "scatter", "mode": "lines", "x": x, "y": normal, "hoverinfo": "skip",
        "line": {"color": MUTED, "width": 1.5, "dash": "dot"},
    }  # fmt: skip
    axis = {"gridcolor": RULE, "zeroline": False, "fixedrange": True}
    return make_figure(
        [bars, curve],
        showlegend=False, bargap=0, margin={"l": 44, "r": 8, "t": 6, "b": 36},
        xaxis={**axis, "title": {"text": "residual / σ"},
               "range": [-_MAX_RESIDUAL - _BIN_WIDTH, _MAX_RESIDUAL + _BIN_WIDTH],
               "tickvals": [-4, -2, 0, 2, 4]},
        yaxis={**axis, "rangemode": "tozero"},
    )  # fmt: skip


def _render_distances(calibration: Calibration, words: Vocabulary) -> Markup:
    """A box for each sensor with the distances of its captures or walks; empty where there are none."""
    distances: dict[str, list[float]] = {sensor.name: [] for sensor in calibration.sensors}
    for row in calibration.evidence.captures:
        if row.used and row.residual is not None and np.isfinite(row.residual):
            distances.setdefault(row.sensor, []).append(1e3 * row.residual)
    by_sensor = {name: values for name, values in distances.items() if values}
    if not by_sensor:
        return Markup()
    boxes = [
        {
            "type": "box", "x": np.array(values).round(3), "name": escape_plotly(name),
            "marker": {"color": BLUE, "size": 3}, "line": {"width": 1.5}, "boxpoints": "outliers",
            "hoverinfo": "x+name",
        }
        for name, values in by_sensor.items()
    ]  # fmt: skip
    drawing = make_figure(
        boxes,
        showlegend=False, margin={"l": 10, "r": 10, "t": 6, "b": 40},
        xaxis={"title": {"text": "distance, mm"}, "gridcolor": RULE, "rangemode": "tozero", "fixedrange": True},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True},
    )  # fmt: skip
    return render_figure("spreads", drawing, 70 + 34 * len(by_sensor), f"Distances of each {words.item} by sensor")


# Largest number of points of a figure, and of one figure of each sensor in all, which bound the size of the page.
_MAX_POINTS, _MAX_POINTS_IN_ALL = 1200, 24_000
# With more sensors than this their figures are collapsed.
_MAX_EXPANDED = 12
# Bins of a mean, and fewest residuals of a bin.
_BINS, _MIN_IN_BIN = 16, 8
# Times that are drawn one by one, as captures are; more are binned.
_MAX_TIMES = 80
# Lines over time stop where the next time is farther than this, in median steps.
_GAP = 3.0
# Smallest drawn length of the median reprojection error, relative to the image width.
_VISIBLE_ERROR = 0.02
_HEIGHT = 300
_CONSTANT_DOTS = {"itemsizing": "constant"}
# Radii of the circles in a scatter, standard deviations of one coordinate.
_CIRCLES = (1, 3)
# Colours from the begin to the end of the recording, and of directions.
_TIME_SCALE = "Viridis"
_CYCLIC_SCALE = [[0, BLUE], [0.25, GREEN], [0.5, ORANGE], [0.75, PINK], [1, BLUE]]


@dataclass(frozen=True, eq=False)
class _Residuals:
    """The residuals of one sensor."""

    time: Array
    """(N,) s; of a rig, of the middle of the capture."""
    points: Array
    """(N, 2) px of a camera; (N, 3) of a scanner in its frame, m."""
    error: Array
    """(N, 2) px, or (N, 1) mm."""
    shown: slice
    """Rows that are drawn one by one."""
    unused: Array
    """(M, 2) corners of a camera that the joint solution did not use, px; of a scanner none."""
    incidence: Array
    """(N,) angles of beams to the normals of surfaces, degrees; (0,) where there are no surfaces."""


def render_residual_pictures(calibration: Calibration, rig: Rig, words: Vocabulary) -> Markup:
    """Three figures for each sensor; empty where the result has no residuals in their units."""
    cameras = calibrated_cameras(calibration, rig)
    limit = min(_MAX_POINTS, _MAX_POINTS_IN_ALL // len(calibration.sensors))
    shown = [
        (sensor.name, *_draw_sensor(f"errors-{k}", sensor.name, residuals, cameras.get(sensor.name)))
        for k, sensor in enumerate(calibration.sensors)
        if (residuals := _collect(calibration, sensor, limit)) is not None
    ]
    return render("residuals.html", words=words, sensors=shown, collapsed=len(calibration.sensors) > _MAX_EXPANDED)


def _collect(calibration: Calibration, sensor: SensorPose, limit: int) -> _Residuals | None:
    times, own = capture_times(calibration), calibration.pictures.of_sensor(sensor.name)
    parts = [
        (np.full(len(view.measured), times.get(view.capture, np.nan)), view.measured, view.residuals)
        for view in own.board_views
        if view.residuals is not None
    ]
    parts += [
        (view.times, np.column_stack([view.points, np.zeros(len(view.points))]), view.residuals)
        for view in own.beam_views
    ]
    parts += [(view.times, view.points.astype(np.float64), view.residuals) for view in own.drive_views]
    if not parts:
        return None
    angles = [find_incidence(view, own.drive_paths[view.part], sensor.T_root_sensor) for view in own.drive_views]
    time, points, error = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    error = error if error.ndim == 2 else 1e3 * error[:, None]
    finite = np.isfinite(error).all(axis=1) & np.isfinite(points).all(axis=1)
    is_camera = KINDS[sensor.kind].detects == "corners"
    unused = [view.measured for view in own.board_views if view.residuals is None and is_camera]
    if not finite.any():
        return None
    corners = np.concatenate([np.zeros((0, 2)), *unused])
    shown = _thin(int(finite.sum()), limit)
    incidence = np.concatenate([np.zeros(0), *angles])
    return _Residuals(
        time[finite], points[finite], error[finite], shown, corners[_thin(len(corners), limit)],
        incidence[finite] if len(incidence) else incidence,
    )  # fmt: skip


def _draw_sensor(
    name: str, sensor: str, of: _Residuals, camera: CameraModel | None
) -> tuple[str, list[tuple[str, Markup]]]:
    """The size of a sensor's residuals, and its figures by caption."""
    size = float(np.sqrt(np.mean(np.sum(of.error**2, axis=1))))
    if of.error.shape[1] == 2:
        facts = f"reprojection error {format_error(size, 'px')} RMS"
        figures = [("Error in x and y; circles: 1 and 3 σ", _scatter(of))]
        if camera is not None:
            factor = choose_enlargement(
                float(np.median(np.linalg.norm(of.error, axis=1))), _VISIBLE_ERROR * camera.width
            )
            figures.append((f"Over the image, enlarged {factor} ×", _over_image(of, camera, factor)))
            figures.append(("Radial error, outwards", _over_radius(of, camera)))
    else:
        facts = f"residual {format_error(size / 1e3, 'm')} RMS"
        x, y, z = of.points.T
        planar = not np.ptp(z)
        angle = np.degrees(np.arctan2(y, x) if planar else np.arctan2(z, np.hypot(x, y)))
        figures = [
            ("Over range", _over(np.linalg.norm(of.points, axis=1), of.error[:, 0], of.shown, "range, m", "mm")),
            (f"Over {'azimuth' if planar else 'elevation'}",
             _over(angle, of.error[:, 0], of.shown, "azimuth, °" if planar else "elevation, °", "mm")),
        ]  # fmt: skip
    if len(of.incidence):
        # Some points within the gate are of people or furniture before the surface.
        typical = STDDEV_PER_MAD * float(np.median(np.abs(of.error)))
        facts += f", {format_error(typical / 1e3, 'm')} by the median"
        figures.append(
            ("Over incidence", _over(of.incidence, of.error[:, 0], of.shown, "angle to the normal, °", "mm"))
        )
    figures.append(("Over time", _over_time(of)))
    return facts, [
        (caption, render_figure(f"{name}-{i}", figure, _HEIGHT, f"{sensor}: {caption}"))
        for i, (caption, figure) in enumerate(figures)
    ]


def _scatter(of: _Residuals) -> Figure:
    """Reprojection errors in x and y, coloured by time."""
    rows = of.shown
    sigma = float(np.sqrt(np.mean(of.error**2)))
    limit = max(float(np.max(np.abs(of.error))), _CIRCLES[-1] * sigma) * 1.08
    axis = {**_axis("", tick=True), "range": [-limit, limit]}
    turn = np.linspace(0, 2 * np.pi, 61)
    circles = [
        _line(radius * sigma * np.cos(turn), radius * sigma * np.sin(turn), MUTED, f"{radius} σ", dash="dot")
        for radius in _CIRCLES
    ]
    dots = _dots(of.error[rows, 0], of.error[rows, 1]) | {
        "marker": {
            "size": 4, "color": of.time[rows], "colorscale": _TIME_SCALE, "opacity": 0.8,
            "colorbar": {"title": {"text": "s"}, "thickness": 8, "outlinewidth": 0, "x": 1.02},
        },
        "hovertemplate": "%{x:.3f}, %{y:.3f} px<extra></extra>",
    }  # fmt: skip
    return _finish(
        [dots, *circles],
        {**axis, "title": {"text": "error in x, px"}, "constrain": "domain"},
        {**axis, "title": {"text": "error in y, px"}, "scaleanchor": "x", "constrain": "domain"},
    )


def _over_image(of: _Residuals, camera: CameraModel, factor: int) -> Figure:
    """Reprojection errors as enlarged lines from the predicted corners, which are coloured by their direction."""
    rows = of.shown
    start = of.points[rows] - of.error[rows]
    lines = np.stack([start, start + factor * of.error[rows], np.full_like(start, np.nan)], axis=1).reshape(-1, 2)
    size = np.linalg.norm(of.error[rows], axis=1)
    direction = np.degrees(np.arctan2(of.error[rows, 1], of.error[rows, 0]))
    dots = _dots(*start.T) | {
        "marker": {
            "size": 4, "color": direction, "colorscale": _CYCLIC_SCALE, "cmin": -180, "cmax": 180,
            "colorbar": {"tickvals": [-180, -90, 0, 90], "ticktext": ["left", "up", "right", "down"],
                         "thickness": 8, "outlinewidth": 0, "x": 1.02},
        },
        "text": [format_significant(float(value)) for value in size],
        "hovertemplate": "%{text} px at %{x:.0f}, %{y:.0f}<extra></extra>",
    }  # fmt: skip
    unused = _dots(*of.unused.T) | {
        "name": "not used", "showlegend": len(of.unused) > 0,
        "marker": {"symbol": "x-thin", "size": 5, "line": {"width": 1, "color": VERMILION}},
    }  # fmt: skip
    return _finish(
        [unused, _line(lines[:, 0], lines[:, 1], MUTED, "errors", legend=False), dots | {"showlegend": False}],
        {**_axis("x, px"), "range": [-0.5, camera.width - 0.5], "constrain": "domain"},
        {**_axis("y, px"), "range": [camera.height - 0.5, -0.5], "scaleanchor": "x", "constrain": "domain"},
        legend=len(of.unused) > 0,
    )


def _over_radius(of: _Residuals, camera: CameraModel) -> Figure:
    """Errors towards the border of the image, which a wrong focal length or distortion causes."""
    offset = of.points - of.error - (np.array([camera.width, camera.height]) - 1) / 2
    radius = np.linalg.norm(offset, axis=1)
    outwards = np.sum(of.error * offset, axis=1) / np.maximum(radius, 1e-9)
    return _over(radius, outwards, of.shown, "distance from the image centre, px", "px")


def _over(x: Array, error: Array, rows: slice, title: str, unit: str) -> Figure:
    """Residuals over a quantity, with the mean and the standard deviation in each bin."""
    dots = _dots(x[rows], error[rows]) | {"marker": {"size": 3, "color": MUTED, "opacity": 0.35}}
    centers, means, deviations = _bin(x, error)
    return _finish(
        [
            dots | {"name": "single"},
            _line(centers, means - deviations, ORANGE, "mean ± σ", dash="dot"),
            _line(centers, means + deviations, ORANGE, "", dash="dot", legend=False),
            _line(centers, means, BLUE, "mean", mode="lines+markers"),
        ],
        _axis(title),
        {**_axis(f"residual, {unit}", tick=True), "range": _symmetric_limits(error)},
        legend=True,
    )  # fmt: skip


def _over_time(of: _Residuals) -> Figure:
    """RMS and mean residual of each capture, or of intervals of time."""
    time = of.time[np.isfinite(of.time)]
    if len(np.unique(time)) > _MAX_TIMES:
        edges = np.linspace(time.min(), time.max(), _MAX_TIMES // 2 + 1)
        group = np.clip(np.searchsorted(edges, of.time, side="right") - 1, 0, len(edges) - 2)
    else:
        group = np.searchsorted(np.unique(time), of.time)
    each = [np.isfinite(of.time) & (group == k) for k in np.unique(group)]
    each = [rows for rows in each if rows.any()]
    at = np.array([of.time[rows].mean() for rows in each])
    total = np.array([np.sqrt(np.mean(np.sum(of.error[rows] ** 2, axis=1))) for rows in each])
    means = np.array([of.error[rows].mean(axis=0) for rows in each]).reshape(len(each), -1)
    steps = np.diff(at)
    gaps = np.flatnonzero(steps > _GAP * (np.median(steps) if len(steps) else 1.0)) + 1
    at, total, means = (np.insert(values, gaps, np.nan, axis=0) for values in (at, total, means))
    unit = "px" if of.error.shape[1] == 2 else "mm"
    names = ("mean in x", "mean in y") if unit == "px" else ("mean",)
    colors = (BLUE, VERMILION)
    return _finish(
        [
            _line(at, total, MUTED, "RMS", mode="lines+markers", dash="dot"),
            *(_line(at, means[:, i], colors[i], name, mode="markers") for i, name in enumerate(names)),
        ],
        _axis("time from the start, s"),
        _axis(f"residual, {unit}", tick=True),
        legend=True,
    )


def _bin(x: Array, error: Array) -> tuple[Array, Array, Array]:
    """Centres, means and standard deviations of the residuals in bins of equal width."""
    edges = np.linspace(x.min(), x.max(), _BINS + 1)
    group = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _BINS - 1)
    # NaN, at which lines stop, where there are too few.
    means, deviations = np.full((2, _BINS), np.nan)
    for k in range(_BINS):
        rows = group == k
        if np.sum(rows) >= _MIN_IN_BIN:
            means[k], deviations[k] = error[rows].mean(), error[rows].std()
    return (edges[:-1] + edges[1:]) / 2, means, deviations


def _symmetric_limits(error: Array) -> list[float]:
    """All but the largest residuals, which would make the others invisible."""
    limit = 1.2 * float(np.percentile(np.abs(error), 99.5)) or 1.0
    return [-limit, limit]


def _thin(count: int, limit: int) -> slice:
    return slice(None, None, count // limit + 1)


def _dots(x: Array, y: Array) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "x": x,
        "y": y,
        "hovertemplate": "%{x:.4g}, %{y:.3g}<extra></extra>",
    }


def _line(
    x: Array, y: Array, color: str, name: str, *, dash: str = "solid", mode: str = "lines", legend: bool = True
) -> dict[str, Any]:
    return {
        "type": "scatter", "mode": mode, "x": x, "y": y, "name": name, "showlegend": legend,
        "line": {"color": color, "width": 1.5, "dash": dash}, "marker": {"color": color, "size": 5},
        "hovertemplate": f"{name}: %{{y:.3g}}<extra></extra>" if "markers" in mode else None,
        "hoverinfo": "skip" if mode == "lines" else "all",
    }  # fmt: skip


def _axis(title: str, *, tick: bool = False) -> dict[str, Any]:
    return {"title": {"text": title}, "gridcolor": RULE, "zeroline": tick, "zerolinecolor": MUTED}


def _finish(
    traces: Sequence[dict[str, Any]], x: dict[str, Any], y: dict[str, Any], *, legend: bool = False
) -> Figure:
    return make_figure(
        list(traces),
        showlegend=legend,
        legend={"orientation": "h", "y": 1, "yanchor": "bottom", "x": 0, "font": {"size": 11}, **_CONSTANT_DOTS},
        margin={"l": 52, "r": 8, "t": 22, "b": 40},
        xaxis=x, yaxis=y,
    )  # fmt: skip

"""The drive: a plan of trajectory and walls before and after, what surfaces contribute, and the motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.geometry import Array, so3
from calgraph.report.figures import (
    BLUE,
    COLOR_CYCLE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    RULE,
    VERMILION,
    Chooser,
    escape_plotly,
    make_figure,
    render_figure,
)
from calgraph.report.formatting import format_fixed, format_length, format_significant
from calgraph.report.templates import render
from calgraph.result import Calibration, DrivePath, DriveStart, DriveView
from calgraph.surfaces.placed_points import place_points
from calgraph.surfaces.trajectory import Track

# Points of all sensors in the plan of one part, and in all parts; more make browsers slow, and the file large.
_MAX_PART_POINTS, _MAX_POINTS = 6000, 24_000
# Largest vertical part of the normal of a wall, and least of a floor or a ceiling: 30 degrees from either.
_WALL, _LEVEL = 0.5, 0.87
# Between marks of the time along the trajectory, and between the drawn places, s.
_MARK_STEP, _PATH_STEP = 5.0, 0.2
_HEIGHT, _MOTION_HEIGHT = 620, 340
# Percentage of the walls within the initial view, and its margin, m.
_INNER_PERCENT, _VIEW_MARGIN = 97, 1.0
# Speeds and rates below this are 0, m/s and °/s: rates about axes in the plane of a planar drive.
_LEAST_RATE = 1e-6
_AXES = ("x", "y", "z", "about x", "about y", "about z")


def render_drive(calibration: Calibration) -> Markup:
    """The section on the drive; empty where the result has no trajectory."""
    pictures = calibration.pictures
    if not pictures.drive_paths:
        return Markup()
    return render(
        "drive.html", plan=_render_plan(calibration), distances=_compare_distances(calibration),
        supports=_render_supports(calibration), motion=_render_motion(pictures.drive_paths),
        clocks=_describe_clocks(calibration), parts=len(pictures.drive_paths),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Map:
    """The points of one sensor in one part of the drive, in its world."""

    view: DriveView
    after: Array
    """(N, 3) by the calibration, m,"""
    before: Array
    """and by the start; the root has none."""


def _list_maps(calibration: Calibration) -> list[_Map]:
    starts = {one.sensor: one for one in calibration.pictures.drive_starts}
    maps, posed = [], {sensor.name for sensor in calibration.sensors}
    for view in calibration.pictures.drive_views:
        if view.sensor not in posed:
            continue
        sensor, path = calibration[view.sensor], calibration.pictures.drive_paths[view.part]
        offset = sensor.clock_offset or 0.0
        start = starts.get(view.sensor, DriveStart(view.sensor, sensor.T_root_sensor, offset))
        after = place_points(view, path, sensor.T_root_sensor)
        before = place_points(view, path, start.T_root_sensor, offset - start.clock_offset)
        maps.append(_Map(view, after, before))
    return maps


def _compare_distances(calibration: Calibration) -> list[tuple[str, ...]]:
    """By sensor and kind of common surfaces: share of its points, and their median distance before and after."""
    rows: list[tuple[str, ...]] = []
    found: dict[str, list[Array]] = {one.sensor: [] for one in calibration.pictures.drive_starts}
    for one in _list_maps(calibration):
        moved = np.einsum("ni,ni->n", one.before - one.after, one.view.normals)
        of_view = one.view.residuals + moved, one.view.residuals, np.abs(one.view.normals[:, 2]), one.view.shared
        found.get(one.view.sensor, []).append(np.column_stack(of_view))
    for name, parts in found.items():
        before, after, upright, shared = np.concatenate([np.zeros((0, 4)), *parts]).T
        for kind, of_kind in (("walls", upright < _WALL), ("floors and ceilings", upright > _LEVEL)):
            chosen = (shared > 0) & of_kind
            if chosen.any():
                distances = (format_length(float(np.median(np.abs(of[chosen])))) for of in (before, after))
                rows.append((name, kind, f"{100 * chosen.mean():.0f} %", *distances))
    return rows


def _render_plan(calibration: Calibration) -> Markup:
    """Walls by sensor and the trajectory from above, with buttons for the part and for the poses."""
    paths, maps = calibration.pictures.drive_paths, _list_maps(calibration)
    names = [sensor.name for sensor in calibration.sensors]
    limit = min(_MAX_PART_POINTS, _MAX_POINTS // len(paths))
    traces: list[tuple[int, str, dict[str, Any]]] = []
    for part, path in enumerate(paths):
        own = [one for one in maps if one.view.part == part]
        walls = [np.flatnonzero(np.abs(one.view.normals[:, 2]) < _WALL) for one in own]
        step = sum(map(len, walls)) // limit + 1
        for state in ("before", "after")[not calibration.pictures.drive_starts :]:
            traces += [
                (
                    part,
                    state,
                    _draw_walls(one.view.sensor, names.index(one.view.sensor), getattr(one, state)[rows[::step]]),
                )
                for one, rows in zip(own, walls, strict=True)
            ]
        traces += [(part, "", trace) for trace in _draw_path(path)]
    states = {"before: start by motion": "before", "after: calibrated": "after"}
    poses = Chooser(
        "Poses", {words: {"visible": [None if own in ("", state) else False for _, own, _ in traces]}
                  for words, state in states.items()}, 1,
    )  # fmt: skip
    choosers = [poses] if calibration.pictures.drive_starts else []
    if len(paths) > 1:
        choices = {
            f"{path.times[0]:.0f} to {path.times[-1]:.0f} s": {"visible": [own == part for own, *_ in traces]}
            for part, path in enumerate(paths)
        }
        choosers.insert(0, Chooser("Part of the drive", choices, 0))
    axis = {"gridcolor": RULE, "zeroline": False, "ticksuffix": " m"}
    (left, bottom), (right, top) = _find_limits(maps, paths)
    figure = make_figure(
        [trace | {"visible": part == 0} for part, _, trace in traces],
        margin={"l": 56, "r": 8, "t": 8, "b": 36},
        legend={"orientation": "h", "y": -0.06, "itemsizing": "constant"},
        xaxis={**axis, "range": [left, right]},
        yaxis={**axis, "range": [bottom, top], "scaleanchor": "x"},
    )  # fmt: skip
    return render_figure(
        "drive-plan", figure, _HEIGHT, "Plan of the drive: walls by sensor, and trajectory", choosers
    )


def _find_limits(maps: Sequence[_Map], paths: Sequence[DrivePath]) -> Array:
    """(2, 2) lowest and highest x and y of the trajectories and of most points, m."""
    tail = (100 - _INNER_PERCENT) / 2
    xy = np.concatenate([np.zeros((1, 2)), *(one.after[:, :2] for one in maps)])
    ways = np.concatenate([path.T_world_root[:, :2, 3] for path in paths])
    low, high = np.percentile(xy, [tail, 100 - tail], axis=0)
    return np.stack([
        np.minimum(low, ways.min(axis=0)) - _VIEW_MARGIN, np.maximum(high, ways.max(axis=0)) + _VIEW_MARGIN
    ])  # fmt: skip


def _draw_walls(name: str, number: int, points: Array) -> dict[str, Any]:
    return {
        "type": "scatter", "mode": "markers", "x": points[:, 0].round(3), "y": points[:, 1].round(3),
        "name": escape_plotly(name), "hoverinfo": "skip", "opacity": 0.7,
        "marker": {"color": COLOR_CYCLE[number % len(COLOR_CYCLE)], "size": 2.5},
    }  # fmt: skip


def _draw_path(path: DrivePath) -> list[dict[str, Any]]:
    """The trajectory as a line, and marks with times."""
    rows = _thin(path)
    x, y = path.T_world_root[rows, :2, 3].T
    marks = Track(path.times, path.T_world_root).at(np.arange(path.times[0], path.times[-1], _MARK_STEP))[:, :2, 3]
    times = [f"{path.times[0] + _MARK_STEP * k:.0f} s" for k in range(len(marks))]
    return [
        {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": "trajectory", "hoverinfo": "skip",
         "line": {"color": INK, "width": 1.5}},
        {"type": "scatter", "mode": "markers+text", "x": marks[:, 0], "y": marks[:, 1], "showlegend": False,
         "text": times, "textposition": "top center", "textfont": {"size": 10, "color": MUTED},
         "marker": {"color": INK, "size": 5}, "hovertemplate": "%{text}<extra></extra>"},
    ]  # fmt: skip


def _thin(path: DrivePath) -> slice:
    return slice(None, None, max(round(_PATH_STEP / float(np.median(np.diff(path.times)))), 1))


_SURFACES = {"walls beside": BLUE, "walls ahead or behind": ORANGE, "floors and ceilings": GREEN, "slopes": MUTED}
"""Kinds of surfaces by the direction of motion, and their colours."""


def _render_supports(calibration: Calibration) -> Markup:
    """Of which surfaces the pose of each sensor is, along and about each axis; empty without common surfaces."""
    names, axes, shares = [], [], []
    for sensor in calibration.sensors:
        views = calibration.pictures.of_sensor(sensor.name).drive_views
        if sensor.parent is None or not views:
            continue
        information = np.sum([_sum_information(calibration, view) for view in views], axis=0)
        total = information.sum(axis=0)
        for k in np.flatnonzero(total > 0):
            names.append(escape_plotly(sensor.name))
            axes.append(_AXES[k])
            shares.append(100 * information[:, k] / total[k])
    if not shares:
        return Markup()
    traces = [
        {
            "type": "bar", "orientation": "h", "name": kind, "marker": {"color": color}, "x": values,
            "y": [names, axes], "hovertemplate": f"{kind}: %{{x:.0f}} %<extra></extra>",
        }
        for (kind, color), values in zip(_SURFACES.items(), np.array(shares).T, strict=True)
        if values.any()
    ]  # fmt: skip
    figure = make_figure(
        traces, barmode="stack", bargap=0.25, margin={"l": 10, "r": 16, "t": 22, "b": 36},
        legend={"orientation": "h", "y": 1, "yanchor": "bottom", "x": 0, "font": {"size": 11},
                "traceorder": "normal"},
        xaxis={"range": [0, 100], "ticksuffix": " %", "gridcolor": RULE, "fixedrange": True},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True, "dividercolor": RULE},
    )  # fmt: skip
    return render_figure("drive-supports", figure, 90 + 22 * len(shares), "Surfaces that determine each axis")


def _sum_information(calibration: Calibration, view: DriveView) -> Array:
    """(K, 6) sums of squared derivatives of distances from shared surfaces, by kind, along and about root axes."""
    path, rows = calibration.pictures.drive_paths[view.part], view.shared
    T_world_root = Track(path.times, path.T_world_root).at(view.times[rows])
    R = calibration[view.sensor].T_root_sensor[:3, :3]
    normals = view.normals[rows].astype(np.float64)
    n = np.einsum("nji,nj->ni", T_world_root[:, :3, :3], normals)
    arm = view.points[rows].astype(np.float64) @ R.T
    squared = np.concatenate([n, np.cross(arm, n)], axis=1) ** 2
    if calibration.planar:
        squared[:, 2:5] = 0
    x, y = (np.interp(view.times[rows], path.times, v) for v in _velocities(path)[:, :2].T)
    along = np.abs(x * normals[:, 0] + y * normals[:, 1])
    across = np.abs(x * normals[:, 1] - y * normals[:, 0])
    level, wall = np.abs(normals[:, 2]) > _LEVEL, np.abs(normals[:, 2]) < _WALL
    kinds = wall & (along <= across), wall & (along > across), level, ~level & ~wall
    return np.array([squared[kind].sum(axis=0) for kind in kinds])


def _velocities(path: DrivePath) -> Array:
    """(K, 3) m/s."""
    return np.asarray(np.gradient(path.T_world_root[:, :3, 3], path.times, axis=0))


def _render_motion(paths: Sequence[DrivePath]) -> Markup:
    """Speed and turn rates over time."""
    lines: dict[str, list[Array]] = {"speed": [], "turn rate": [], "roll and pitch rate": []}
    times = []
    for path in paths:
        rows = _thin(path)
        R, t = path.T_world_root[:, :3, :3], path.times
        step = so3.log(R[1:] @ np.swapaxes(R[:-1], 1, 2)) / np.diff(t)[:, None]
        rates = np.degrees(np.stack([np.interp(t, (t[1:] + t[:-1]) / 2, column) for column in step.T], axis=1))
        speed = np.linalg.norm(_velocities(path), axis=1)
        for one, values in zip(lines.values(), (speed, rates[:, 2], np.hypot(*rates[:, :2].T)), strict=True):
            one.append(np.append(values[rows], np.nan))
        times.append(np.append(t[rows], np.nan))
    colors = dict(zip(lines, (BLUE, VERMILION, MUTED), strict=True))
    traces = [
        {
            "type": "scatter", "mode": "lines", "x": np.concatenate(times), "y": np.concatenate(values),
            "name": name, "line": {"color": colors[name], "width": 1.5}, "yaxis": "y" if name == "speed" else "y2",
            "hovertemplate": f"%{{x:.1f}} s: %{{y:.3g}} {'m/s' if name == 'speed' else '°/s'}<extra></extra>",
        }
        for name, values in lines.items()
        if np.nanmax(np.abs(np.concatenate(values))) > _LEAST_RATE
    ]  # fmt: skip
    axis = {"gridcolor": RULE, "zeroline": False}
    figure = make_figure(
        traces, margin={"l": 52, "r": 8, "t": 22, "b": 40},
        legend={"orientation": "h", "y": 1, "yanchor": "bottom", "x": 0, "font": {"size": 11}},
        xaxis={**axis, "title": {"text": "time from the start of the drive, s"}, "anchor": "y2"},
        yaxis={**axis, "title": {"text": "m/s"}, "rangemode": "tozero", "domain": [0.62, 1]},
        yaxis2={**axis, "title": {"text": "°/s"}, "zeroline": True, "zerolinecolor": MUTED, "domain": [0, 0.54]},
    )  # fmt: skip
    return render_figure("drive-motion", figure, _MOTION_HEIGHT, "Speed and turn rates of the drive over time")


def _describe_clocks(calibration: Calibration) -> list[tuple[str, str, str, str]]:
    """By sensor, the offset of its clock by turn rates, by the joint solution, and its standard deviation, ms."""
    rows = []
    for start in calibration.pictures.drive_starts:
        sensor = next((one for one in calibration.sensors if one.name == start.sensor), None)
        if sensor is not None and sensor.clock_offset is not None and sensor.clock_offset_stddev is not None:
            before, after = (format_fixed(1000 * value, 2) for value in (start.clock_offset, sensor.clock_offset))
            rows.append((start.sensor, before, after, format_significant(1000 * sensor.clock_offset_stddev)))
    return rows

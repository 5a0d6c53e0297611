"""The floor plan of a network: scanners, their uncertainty, and their measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup
from scipy.special import chdtri

from calgraph.geometry import Array, se2
from calgraph.report.figures import (
    COLOR_CYCLE,
    INK,
    RULE,
    Chooser,
    Figure,
    choose_enlargement,
    escape_plotly,
    make_figure,
    render_figure,
)
from calgraph.report.formatting import format_angle, format_fixed, format_length
from calgraph.result import Calibration, FloorView, SensorPose

# Half axes of the ellipses, standard deviations: 95 % of a normal distribution in the plane, sqrt(χ²₂(0.95)).
_SIGMAS = float(np.sqrt(chdtri(2, 0.05)))
# Smallest longer semi-axis of a visible ellipse, and length of an arrow, relative to the plan.
_MIN_VISIBLE, _ARROW_LENGTH = 0.016, 0.05
# Height of the plan and of a line of the legend, px; names in a line.
_HEIGHT, _LEGEND_LINE_HEIGHT, _NAMES_PER_LINE = 680, 25, 9


def render_floor_plan(calibration: Calibration) -> Markup:
    """The figure, with a sentence on the scale of the uncertainties."""
    calibration = place_on_plan(calibration)
    extent = _plan_extent(calibration)
    factor = _choose_enlargement(calibration.sensors, extent)
    drawn = {view.sensor: view for view in calibration.pictures.floor_views}
    traces = [
        trace | {"meta": k}
        for k, sensor in enumerate(calibration.sensors)
        for trace in _scanner_traces(
            sensor, drawn.get(sensor.name), extent, factor, COLOR_CYCLE[k % len(COLOR_CYCLE)]
        )
    ]
    states = _pose_states(calibration)
    size = "to scale" if factor == 1 else f"{factor} × enlarged"
    caption = f"An ellipse contains the sensor's position with 95 % probability; drawn {size}."
    height = _HEIGHT + _LEGEND_LINE_HEIGHT * (len(calibration.sensors) // _NAMES_PER_LINE)
    # Uncertainties exist for the final poses only.
    only_last = [False if trace.get("fill") else None for trace in traces]
    moved = {words: {"moves": moves, "visible": only_last} for words, moves in states.items()}
    choosers = [Chooser("Poses", moved | {list(moved)[-1]: {}}, len(moved) - 1)] if moved else []
    return render_figure("floor", _make_plan(traces), height, "Floor plan of the network", choosers, caption)


def place_on_plan(calibration: Calibration) -> Calibration:
    """The calibration with its poses and covariances in the plan of the network, in place of the root's frame."""
    T = calibration.pictures.T_plan_root
    if np.array_equal(T, np.eye(4)):
        return calibration
    joint = calibration.joint_covariance.reshape(2 * len(calibration.sensors), 3, -1, 3)
    initial = {name: T @ before for name, before in calibration.evidence.initial_poses.items()}
    return replace(
        calibration,
        sensors=tuple(replace(s, T_root_sensor=T @ s.T_root_sensor) for s in calibration.sensors),
        # By blocks: unknown correlations do not make others unknown.
        joint_covariance=np.einsum("ij,ajbk,lk->aibl", T[:3, :3], joint, T[:3, :3]).reshape(
            calibration.joint_covariance.shape
        ),
        evidence=replace(calibration.evidence, initial_poses=initial),
    )


def _pose_states(calibration: Calibration) -> dict[str, list[list[float]]]:
    """By label, the transforms of each scanner's measurements to its poses before the joint solution."""
    if not calibration.pictures.floor_views:
        return {}
    identity = {sensor.name: np.eye(4) for sensor in calibration.sensors}
    initial = calibration.evidence.initial_poses
    start = {"before: averaged pairs": initial} if initial else {}
    poses_before: dict[str, Mapping[str, Array]] = {"not calibrated: identity poses": identity, **start}
    moves = {
        words: [
            # Scanners from an earlier calibration have no start pose.
            _planar_transform(poses.get(s.name, s.T_root_sensor), s.T_root_sensor)
            for s in calibration.sensors
        ]
        for words, poses in poses_before.items()
    }
    return {**moves, "after: calibrated": []}


def _planar_transform(before: Array, after: Array) -> list[float]:
    """Cosine and sine of the rotation, and the translation, m, from one pose (4, 4) to the other in the plane."""
    T_before, T_after = (se2.pose(float(np.arctan2(T[1, 0], T[0, 0])), T[:2, 3]) for T in (before, after))
    T = T_before @ se2.inverse(T_after)
    return [float(T[0, 0]), float(T[1, 0]), float(T[0, 2]), float(T[1, 2])]


def _make_plan(traces: list[dict[str, Any]]) -> Figure:
    axis = {"gridcolor": RULE, "zerolinecolor": RULE, "ticksuffix": " m"}
    return make_figure(
        traces,
        margin={"l": 56, "r": 8, "t": 8, "b": 36},
        legend={"orientation": "h", "y": -0.06, "itemsizing": "constant"},
        xaxis=axis,
        yaxis={**axis, "scaleanchor": "x"},
    )


def _plan_extent(calibration: Calibration) -> float:
    """The longer side of the plan, m."""
    origins = np.array([sensor.T_root_sensor[:2, 3] for sensor in calibration.sensors])
    measured = [points for view in calibration.pictures.floor_views for points in (view.background, *view.tracks)]
    points = np.concatenate([origins, *measured])
    points = points[np.isfinite(points).all(axis=1)]
    return max(float(np.max(np.ptp(points, axis=0), initial=0.0)), 1.0)


def _choose_enlargement(sensors: Sequence[SensorPose], extent: float) -> int:
    """Smallest enlargement at which half of the ellipses are visible."""
    largest = [np.linalg.eigvalsh(s.covariance[:2, :2])[-1] for s in _with_uncertainty(sensors)]
    typical = _SIGMAS * float(np.sqrt(np.median(largest))) if largest else np.inf
    return choose_enlargement(typical, _MIN_VISIBLE * extent)


def _with_uncertainty(sensors: Sequence[SensorPose]) -> list[SensorPose]:
    """The sensors with a finite, nonzero covariance: the root has none."""
    return [s for s in sensors if np.isfinite(s.covariance[:2, :2]).all() and s.covariance[:2, :2].any()]


def _scanner_traces(
    sensor: SensorPose, view: FloorView | None, extent: float, factor: int, color: str
) -> list[dict[str, Any]]:
    """All traces of one scanner: one entry of the legend shows and hides them."""
    shared = {"legendgroup": sensor.name, "hoverinfo": "skip", "showlegend": False}
    line = {"type": "scatter", "mode": "lines", **shared}
    traces: list[dict[str, Any]] = []
    if view is not None:
        x, y = view.background.T
        traces.append({**shared, "type": "scatter", "mode": "markers", "x": x, "y": y, "opacity": 0.6,
                       "marker": {"color": color, "size": 2.5}})  # fmt: skip
        x, y = _join_with_gaps(view.tracks).T
        traces.append({**line, "x": x, "y": y, "line": {"color": color, "width": 1}, "opacity": 0.55})
    if _with_uncertainty([sensor]):
        x, y = _uncertainty_ellipse(sensor, factor).T
        traces.append({**line, "x": x, "y": y, "line": {"color": color, "width": 2},
                       "fill": "toself"})  # fmt: skip
    x, y = _axis_arrow(sensor, _ARROW_LENGTH * extent).T
    traces.append({**line, "x": x, "y": y, "line": {"color": INK, "width": 2}})
    x, y = sensor.T_root_sensor[:2, 3]
    traces.append({
        "type": "scatter", "mode": "markers+text", "x": [x], "y": [y], "legendgroup": sensor.name,
        "name": escape_plotly(sensor.name), "text": [escape_plotly(sensor.name)], "textposition": "bottom center",
        "textfont": {"size": 13, "color": INK},
        "marker": {"color": color, "size": 7, "line": {"color": INK, "width": 1}},
        "hovertemplate": f"{_describe_pose(sensor)}<extra></extra>",
    })  # fmt: skip
    return traces


def _join_with_gaps(lines: Sequence[Array]) -> Array:
    """Many lines (N, 2) as one, separated by NaN rows, which plotly does not draw."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([gap, *(part for line in lines for part in (line, gap))])


def _uncertainty_ellipse(sensor: SensorPose, factor: float) -> Array:
    """(N, 2) outline of the uncertainty of a position."""
    variances, directions = np.linalg.eigh(sensor.covariance[:2, :2])
    turn = np.linspace(0, 2 * np.pi, 49)
    unit = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    half_axes = factor * _SIGMAS * np.sqrt(np.maximum(variances, 0))
    return np.asarray(sensor.T_root_sensor[:2, 3] + (unit * half_axes) @ directions.T)


def _axis_arrow(sensor: SensorPose, size: float) -> Array:
    """(N, 2) an arrow along the scanner's x axis."""
    along_x = size * np.array([[0.0, 0], [1, 0], [0.8, 0.1], [1, 0], [0.8, -0.1]])
    return np.asarray(sensor.T_root_sensor[:2, 3] + along_x @ sensor.T_root_sensor[:2, :2].T)


def _describe_pose(sensor: SensorPose) -> str:
    x, y = sensor.T_root_sensor[:2, 3]
    yaw = np.degrees(np.arctan2(sensor.T_root_sensor[1, 0], sensor.T_root_sensor[0, 0]))
    sigma = np.sqrt(np.maximum(np.diag(sensor.measured_covariance), 0))
    position = f"{format_fixed(x, 3)}, {format_fixed(y, 3)} m"
    place = f"<b>{escape_plotly(sensor.name)}</b><br>{position}, yaw {format_fixed(yaw, 2)}°"
    if sensor.parent is None:
        return f"{place}<br>root"
    return f"{place}<br>σ {format_length(sigma[0])}, {format_length(sigma[1])}, {format_angle(sigma[5])}"

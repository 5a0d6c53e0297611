"""The floor plan of a network: scanners, how uncertain they are, and all that they saw, in the root's frame."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.report.figures import INK, RULE, WHEEL, Figure, chooser, figure, placed, plotly_text
from calgraph.report.formatting import angle, fixed, length
from calgraph.result import Calibration, FloorView, SensorPose

_SIGMAS = 2.0
_EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# An ellipse can be seen if its longer half axis takes this part of the plan, as can an arrow of that part.
_VISIBLE, _ARROW = 0.016, 0.05
# Pixels: of the plan, and of a line of the legend, which takes so many names.
_HEIGHT, _LEGEND_LINE, _NAMES = 680, 25, 9


def floor_plan(calibration: Calibration) -> str:
    """The figure, with a sentence on how large uncertainties are drawn."""
    extent = _extent(calibration)
    factor = _exaggeration(calibration.sensors, extent)
    drawn = {view.sensor: view for view in calibration.pictures.floor_views}
    traces = [
        trace | {"meta": k}
        for k, sensor in enumerate(calibration.sensors)
        for trace in _scanner(sensor, drawn.get(sensor.name), extent, factor, WHEEL[k % len(WHEEL)])
    ]
    states = _states(calibration)
    size = "as large as they are" if factor == 1 else f"{factor} times as large as they are"
    words = f"<p>Ellipses: {_SIGMAS:g} standard deviations (σ) of a scanner's position, drawn {size}.</p>"
    height = _HEIGHT + _LEGEND_LINE * (len(calibration.sensors) // _NAMES)
    buttons = chooser("floor", 0, "Poses", list(states), len(states) - 1) if states else ""
    # How uncertain poses are is known of the final ones only.
    only_last = [False if trace.get("fill") else None for trace in traces]
    choices = [{"moves": moves, "visible": only_last} for moves in states.values()]
    plan = _plan(traces) | {"choices": [[*choices[:-1], {}]]}
    return words + buttons + placed("floor", plan, height, "Floor plan of the network")


def _states(calibration: Calibration) -> dict[str, list[list[float]]]:
    """By what they are called, how all that each scanner saw moves to where it was thought to be before."""
    if not calibration.pictures.floor_views:
        return {}
    nowhere = {sensor.name: np.eye(4) for sensor in calibration.sensors}
    start = (
        {"before: pairs averaged": calibration.evidence.initial_poses}
        if calibration.evidence.initial_poses
        else {}
    )
    before: dict[str, Mapping[str, Array]] = {"not calibrated: all in one place": nowhere, **start}
    moves = {
        words: [
            # Scanners that were added from an earlier calibration had no start.
            _move(poses.get(s.name, s.T_root_sensor) @ se3.inverse(s.T_root_sensor))
            for s in calibration.sensors
        ]
        for words, poses in before.items()
    }
    return {**moves, "after: calibrated": []}


def _move(T: Array) -> list[float]:
    """Cosine and sine of the turn, and the shift, m, of a pose (4, 4) in the plane."""
    return [float(T[0, 0]), float(T[1, 0]), float(T[0, 3]), float(T[1, 3])]


def _plan(traces: list[dict[str, Any]]) -> Figure:
    axis = {"gridcolor": RULE, "zerolinecolor": RULE, "ticksuffix": " m"}
    return figure(
        traces,
        margin={"l": 56, "r": 8, "t": 8, "b": 36},
        legend={"orientation": "h", "y": -0.06, "itemsizing": "constant"},
        xaxis=axis,
        yaxis={**axis, "scaleanchor": "x"},
    )


def _extent(calibration: Calibration) -> float:
    """The longer side of the plan, m."""
    origins = np.array([sensor.T_root_sensor[:2, 3] for sensor in calibration.sensors])
    seen = [points for view in calibration.pictures.floor_views for points in (view.background, *view.tracks)]
    points = np.concatenate([origins, *seen])
    points = points[np.isfinite(points).all(axis=1)]
    return max(float(np.max(np.ptp(points, axis=0), initial=0.0)), 1.0)


def _exaggeration(sensors: Sequence[SensorPose], extent: float) -> int:
    """How many times larger ellipses must be drawn for half of them to be seen."""
    largest = [np.linalg.eigvalsh(s.covariance[:2, :2])[-1] for s in _uncertain(sensors)]
    typical = _SIGMAS * float(np.sqrt(np.median(largest))) if largest else np.inf
    return next((f for f in _EXAGGERATIONS if f * typical >= _VISIBLE * extent), _EXAGGERATIONS[-1])


def _uncertain(sensors: Sequence[SensorPose]) -> list[SensorPose]:
    """Those whose uncertainty can be drawn: the root has none."""
    return [s for s in sensors if np.isfinite(s.covariance).all() and s.covariance[:2, :2].any()]


def _scanner(
    sensor: SensorPose, view: FloorView | None, extent: float, factor: int, color: str
) -> list[dict[str, Any]]:
    """All that is drawn of one scanner: one entry of the legend shows and hides it."""
    shared = {"legendgroup": sensor.name, "hoverinfo": "skip", "showlegend": False}
    line = {"type": "scatter", "mode": "lines", **shared}
    traces: list[dict[str, Any]] = []
    if view is not None:
        x, y = view.background.T
        traces.append({**shared, "type": "scatter", "mode": "markers", "x": x, "y": y, "opacity": 0.6,
                       "marker": {"color": color, "size": 2.5}})  # fmt: skip
        x, y = _with_gaps(view.tracks).T
        traces.append({**line, "x": x, "y": y, "line": {"color": color, "width": 1}, "opacity": 0.55})
    if _uncertain([sensor]):
        x, y = _ellipse(sensor, factor).T
        traces.append({**line, "x": x, "y": y, "line": {"color": color, "width": 2},
                       "fill": "toself"})  # fmt: skip
    x, y = _arrow(sensor, _ARROW * extent).T
    traces.append({**line, "x": x, "y": y, "line": {"color": INK, "width": 2}})
    x, y = sensor.T_root_sensor[:2, 3]
    traces.append({
        "type": "scatter", "mode": "markers+text", "x": [x], "y": [y], "legendgroup": sensor.name,
        "name": plotly_text(sensor.name), "text": [plotly_text(sensor.name)], "textposition": "bottom center",
        "textfont": {"size": 13, "color": INK},
        "marker": {"color": color, "size": 7, "line": {"color": INK, "width": 1}},
        "hovertemplate": f"{_pose_in_words(sensor)}<extra></extra>",
    })  # fmt: skip
    return traces


def _with_gaps(lines: Sequence[Array]) -> Array:
    """Many lines (N, 2) as one, with a row that plotly does not draw after each."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([gap, *(part for line in lines for part in (line, gap))])


def _ellipse(sensor: SensorPose, factor: float) -> Array:
    """(N, 2) outline of the uncertainty of a position."""
    variances, directions = np.linalg.eigh(sensor.covariance[:2, :2])
    turn = np.linspace(0, 2 * np.pi, 49)
    unit = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    half_axes = factor * _SIGMAS * np.sqrt(np.maximum(variances, 0))
    return np.asarray(sensor.T_root_sensor[:2, 3] + (unit * half_axes) @ directions.T)


def _arrow(sensor: SensorPose, size: float) -> Array:
    """(N, 2) from the scanner along its x axis, with a head."""
    along_x = size * np.array([[0.0, 0], [1, 0], [0.8, 0.1], [1, 0], [0.8, -0.1]])
    return np.asarray(sensor.T_root_sensor[:2, 3] + along_x @ sensor.T_root_sensor[:2, :2].T)


def _pose_in_words(sensor: SensorPose) -> str:
    x, y = sensor.T_root_sensor[:2, 3]
    yaw = np.degrees(np.arctan2(sensor.T_root_sensor[1, 0], sensor.T_root_sensor[0, 0]))
    sigma = np.sqrt(np.maximum(np.diag(sensor.covariance), 0))
    place = f"<b>{plotly_text(sensor.name)}</b><br>{fixed(x, 3)}, {fixed(y, 3)} m, turned by {fixed(yaw, 2)}°"
    if sensor.parent is None:
        return f"{place}<br>root"
    return f"{place}<br>σ {length(sigma[0])}, {length(sigma[1])}, {angle(sigma[5])}"

"""The 3-D view of the rig: its frames, what they see, where the board was, and how uncertain positions are."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from calgraph.report.figures import BLUE, GREEN, MUTED, RULE, VERMILION, figure, placed, plotly_text
from calgraph.report.rig_shapes import Polyline, axes, ellipsoid, frustum, scan_circle
from calgraph.result import Calibration, SensorPose
from calgraph.rig import Rig
from calgraph.sensors import CameraModel

_EXAGGERATIONS = (1.0, 10.0, 100.0)
_AXES = (("x", VERMILION), ("y", GREEN), ("z", BLUE))
_FANS = (-0.26, -0.09, 0.09, 0.26)
"""Elevations of the beams drawn for a 3-D LiDAR, rad."""


def rig_view(calibration: Calibration, rig: Rig) -> str:
    """The figure, with buttons for what to look at and how large to draw uncertainties."""
    size = _size_of_frames(calibration)
    fixed = [
        *(_lines(f"{name} axes", [axes(s.T_root_sensor, size)[i] for s in calibration.sensors], color, 5)
          for i, (name, color) in enumerate(_AXES)),
        _names(calibration.sensors),
        _lines("camera views", _frustums(calibration, rig, size), "#7b3294", 2),
        *_discs(calibration, 1.8 * size),
        _lines("2-D scan planes", _circles(calibration, "lidar2d", 1.8 * size, (0.0,)), "#a6761d", 2),
        _lines("3-D LiDAR beams", _circles(calibration, "lidar3d", 1.5 * size, _FANS), "#56b4e9", 2),
        _lines("boards", [np.concatenate([o.corners, o.corners[:1]]) for o in calibration.outlines], MUTED, 1.5),
    ]  # fmt: skip
    fixed = [trace for trace in fixed if len(trace["x"])]
    sensors = [s for s in calibration.sensors if s.parent is not None and np.any(s.covariance[:3, :3])]
    limit = 3 * size
    groups = [[_ellipsoid(s, factor, limit, factor == 1) for s in sensors] for factor in _EXAGGERATIONS]
    ellipsoids = [trace for group in groups for trace in group]
    layout = {
        "margin": {"l": 0, "r": 0, "t": 44, "b": 0},
        "legend": {"orientation": "h", "y": 0, "itemsizing": "constant"},
        "scene": _scene(calibration, size),
        "updatemenus": [_views(calibration, size), *_sizes(len(fixed), len(sensors))],
    }
    return placed("rig", figure([*fixed, *ellipsoids], **layout), 600, "The rig in space")


def _size_of_frames(calibration: Calibration) -> float:
    """Length of a frame's axes, m: clear of its neighbours, yet to be seen."""
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    if len(origins) < 2:
        return 0.25
    distances = np.linalg.norm(origins[:, None] - origins, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return float(np.clip(0.4 * np.median(distances.min(axis=1)), 0.05, 2.0))


def _lines(name: str, lines: Sequence[Polyline], color: str, width: float) -> dict[str, Any]:
    """Many lines as one trace: a gap, which plotly writes as null, between each two."""
    points: list[list[float | None]] = []
    for line in lines:
        points += [*line.tolist(), [None, None, None]]
    x, y, z = zip(*points, strict=True) if points else ((), (), ())
    return {
        "type": "scatter3d", "mode": "lines", "name": name, "x": x, "y": y, "z": z,
        "line": {"color": color, "width": width}, "hoverinfo": "skip",
    }  # fmt: skip


def _names(sensors: Sequence[SensorPose]) -> dict[str, Any]:
    origins = np.array([s.T_root_sensor[:3, 3] for s in sensors])
    return {
        "type": "scatter3d", "mode": "markers+text", "name": "sensors", "x": origins[:, 0].tolist(),
        "y": origins[:, 1].tolist(), "z": origins[:, 2].tolist(), "text": [s.name for s in sensors],
        # Text in the scene is drawn as it is; hover labels know tags.
        "customdata": [plotly_text(s.name) for s in sensors],
        "textposition": "top center", "marker": {"size": 4, "color": "#1f2933"},
        "hovertemplate": "<b>%{customdata}</b><br>%{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>",
    }  # fmt: skip


def _frustums(calibration: Calibration, rig: Rig, size: float) -> list[Polyline]:
    cameras = [s for s in calibration.sensors if s.kind == "camera"]
    return [line for s in cameras for line in frustum(s.T_root_sensor, _intrinsics(s.name, rig), 1.5 * size)]


def _intrinsics(name: str, rig: Rig) -> CameraModel | None:
    spec = rig.cameras().get(name)
    return spec.intrinsics.camera() if spec and spec.intrinsics else None


def _circles(calibration: Calibration, kind: str, radius: float, elevations: Sequence[float]) -> list[Polyline]:
    sensors = [s for s in calibration.sensors if s.kind == kind]
    return [scan_circle(s.T_root_sensor, radius, e) for s in sensors for e in elevations]


def _discs(calibration: Calibration, radius: float) -> list[dict[str, Any]]:
    """The scan planes as faint discs."""
    discs = []
    for sensor in calibration.sensors:
        if sensor.kind == "lidar2d":
            rim = scan_circle(sensor.T_root_sensor, radius)[:-1]
            x, y, z = np.concatenate([rim, sensor.T_root_sensor[None, :3, 3]]).T
            i = np.arange(len(rim))
            discs.append({
                "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": (i + 1) % len(rim),
                "k": np.full_like(i, len(rim)),
                "color": "#a6761d", "opacity": 0.1, "hoverinfo": "skip",
            })  # fmt: skip
    return discs


def _ellipsoid(sensor: SensorPose, exaggeration: float, limit: float, visible: bool) -> dict[str, Any]:
    vertices, triangles = ellipsoid(sensor.T_root_sensor[:3, 3], sensor.covariance[:3, :3], exaggeration, limit)
    x, y, z = vertices.T
    i, j, k = triangles.T
    return {
        "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "color": "#cc79a7", "opacity": 0.35,
        "visible": visible, "name": plotly_text(sensor.name), "hoverinfo": "name", "flatshading": False,
    }  # fmt: skip


def _scene(calibration: Calibration, size: float) -> dict[str, Any]:
    axis = {"backgroundcolor": "#ffffff", "gridcolor": RULE, "zerolinecolor": RULE, "showspikes": False}
    ranges = _ranges(calibration, size)
    named = {f"{n}axis": {**axis, "title": {"text": f"{n}, m"}, "range": r}
             for n, r in zip("xyz", ranges, strict=True)}  # fmt: skip
    return {
        **named,
        "aspectmode": "cube",
        "camera": {"eye": {"x": 1.25, "y": -1.25, "z": 0.7}, "center": {"x": 0, "y": 0, "z": -0.12}},
    }


def _ranges(calibration: Calibration, size: float) -> list[list[float]]:
    """A cube around the rig, per axis, m: seen from afar it looks the same however the rig is stretched."""
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    low, high = origins.min(axis=0), origins.max(axis=0)
    half = float(np.max(high - low)) / 2 + 2 * size
    return [[float(middle - half), float(middle + half)] for middle in (low + high) / 2]


def _views(calibration: Calibration, size: float) -> dict[str, Any]:
    """Buttons: the rig alone, or everything."""
    rig: dict[str, Any] = {
        f"scene.{n}axis.range": r for n, r in zip("xyz", _ranges(calibration, size), strict=True)
    }
    rig["scene.aspectmode"] = "cube"
    everything = {**{f"scene.{n}axis.autorange": True for n in "xyz"}, "scene.aspectmode": "data"}
    return _menu(0.0, [("the rig", "relayout", [rig]), ("with the boards", "relayout", [everything])])


def _sizes(fixed: int, sensors: int) -> list[dict[str, Any]]:
    """Buttons: how large to draw the uncertainties."""
    if not sensors:
        return []
    traces = list(range(fixed, fixed + sensors * len(_EXAGGERATIONS)))
    buttons = []
    for chosen in (None, *_EXAGGERATIONS):
        label = "no uncertainty" if chosen is None else "95 % ellipsoids" if chosen == 1 else f"× {chosen:g}"
        visible = [factor == chosen for factor in _EXAGGERATIONS for _ in range(sensors)]
        buttons.append((label, "restyle", [{"visible": visible}, traces]))
    return [_menu(0.99, buttons, active=1)]


def _menu(x: float, buttons: Sequence[tuple[str, str, list[Any]]], active: int = 0) -> dict[str, Any]:
    return {
        "type": "buttons", "direction": "right", "x": x, "xanchor": "left" if x == 0 else "right", "y": 1.0,
        "yanchor": "bottom", "active": active, "pad": {"b": 6}, "bgcolor": "#ffffff", "bordercolor": RULE,
        "buttons": [{"label": label, "method": method, "args": args} for label, method, args in buttons],
    }  # fmt: skip

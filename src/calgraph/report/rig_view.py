"""The 3-D view of the rig: its frames, what they see, where the board was, and how uncertain positions are."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.report.figures import (
    BLUE,
    BROWN,
    GREEN,
    INK,
    MUTED,
    PAPER,
    PINK,
    PURPLE,
    RULE,
    SKY,
    VERMILION,
    chooser,
    figure,
    placed,
    plotly_text,
)
from calgraph.report.rig_shapes import SCALE_95, Polyline, axes, ellipsoid, frustum, scan_circle
from calgraph.result import Calibration, SensorPose
from calgraph.result.used_intrinsics import calibrated_cameras

_EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# An ellipsoid can be seen if its longest half axis takes this part of an axis of a frame.
_VISIBLE = 0.25

Choice = dict[str, dict[str, Any]]
"""What buttons change in the figure, by what they are called."""
_AXES = (("x", VERMILION), ("y", GREEN), ("z", BLUE))
_FANS = (-0.26, -0.09, 0.09, 0.26)
"""Elevations of the beams drawn for a 3-D LiDAR, rad."""


def rig_view(calibration: Calibration, rig: Rig) -> str:
    """The figure, with buttons for what to look at and how large to draw uncertainties, and how large they are."""
    size = _size_of_frames(calibration)
    outlines = calibration.pictures.board_outlines
    fixed = [
        *(_lines(f"{name} axes", [axes(s.T_root_sensor, size)[i] for s in calibration.sensors], color, 5)
          for i, (name, color) in enumerate(_AXES)),
        _names(calibration.sensors),
        _lines("camera views", _frustums(calibration, rig, size), PURPLE, 2),
        *_discs(calibration, 1.8 * size),
        _lines("2-D scan planes", _circles(calibration, "lidar2d", 1.8 * size, (0.0,)), BROWN, 2),
        _lines("3-D LiDAR beams", _circles(calibration, "lidar3d", 1.5 * size, _FANS), SKY, 2),
        _lines("boards", [np.concatenate([o.corners, o.corners[:1]]) for o in outlines], MUTED, 1.5),
    ]  # fmt: skip
    fixed = [trace for trace in fixed if len(trace["x"])]
    sensors = [s for s in calibration.sensors if s.parent is not None and np.any(s.covariance[:3, :3])]
    limit, factor = 3 * size, _exaggeration(sensors, size)
    sizes = (1,) if factor == 1 else (1, factor)
    groups = [[_ellipsoid(s, one, limit, one == factor) for s in sensors] for one in sizes]
    ellipsoids = [trace for group in groups for trace in group]
    layout = {
        "margin": {"l": 0, "r": 0, "t": 8, "b": 0},
        "legend": {"orientation": "h", "y": 0, "itemsizing": "constant"},
        "scene": _scene(calibration, size),
    }
    view, drawn = _choice_of_view(calibration, size), _choice_of_size(len(fixed), len(sensors), sizes)
    choices = {"choices": [list(view.values()), list(drawn.values())]}
    buttons = chooser("rig", 0, "What to show", list(view), 0)
    if sensors:
        said = "as large as they are" if factor == 1 else f"<b>{factor} times</b> as large as they are"
        buttons = f"<p>Ellipsoids are drawn {said}.</p>{buttons}"
        buttons += chooser("rig", 1, "Size of the ellipsoids", list(drawn), len(sizes))
    return buttons + placed("rig", figure([*fixed, *ellipsoids], **layout) | choices, 560, "The rig in space")


def _exaggeration(sensors: Sequence[SensorPose], size: float) -> int:
    """How many times larger ellipsoids must be drawn for half of them to be seen beside frames of a size, m."""
    known = [s.covariance[:3, :3] for s in sensors if np.isfinite(s.covariance).all()]
    if not known:
        return 1
    longest = SCALE_95 * np.sqrt(np.median([np.linalg.eigvalsh(one)[-1] for one in known]))
    return next((f for f in _EXAGGERATIONS if f * longest >= _VISIBLE * size), _EXAGGERATIONS[-1])


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
        "textposition": "top center", "marker": {"size": 4, "color": INK},
        "hovertemplate": "<b>%{customdata}</b><br>%{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>",
    }  # fmt: skip


def _frustums(calibration: Calibration, rig: Rig, size: float) -> list[Polyline]:
    known = calibrated_cameras(calibration, rig)
    cameras = [s for s in calibration.sensors if s.kind == "camera"]
    return [line for s in cameras for line in frustum(s.T_root_sensor, known.get(s.name), 1.5 * size)]


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
                "color": BROWN, "opacity": 0.1, "hoverinfo": "skip",
            })  # fmt: skip
    return discs


def _ellipsoid(sensor: SensorPose, exaggeration: float, limit: float, visible: bool) -> dict[str, Any]:
    vertices, triangles = ellipsoid(sensor.T_root_sensor[:3, 3], sensor.covariance[:3, :3], exaggeration, limit)
    x, y, z = vertices.T
    i, j, k = triangles.T
    return {
        "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "color": PINK, "opacity": 0.35,
        "visible": visible, "name": plotly_text(sensor.name), "hoverinfo": "name", "flatshading": False,
    }  # fmt: skip


def _scene(calibration: Calibration, size: float) -> dict[str, Any]:
    axis = {"backgroundcolor": PAPER, "gridcolor": RULE, "zerolinecolor": RULE, "showspikes": False}
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


def _choice_of_view(calibration: Calibration, size: float) -> Choice:
    """The rig alone, or everything."""
    ranges = zip("xyz", _ranges(calibration, size), strict=True)
    rig = {f"{n}axis": {"range": r} for n, r in ranges}
    everything = {f"{n}axis": {"range": None, "autorange": True} for n in "xyz"}
    return {
        "the rig": {"layout": {"scene": {**rig, "aspectmode": "cube"}}},
        "with the boards": {"layout": {"scene": {**everything, "aspectmode": "data"}}},
    }


def _choice_of_size(fixed: int, sensors: int, sizes: Sequence[int]) -> Choice:
    """How large to draw the uncertainties, whose traces come after others."""
    labels = {0: "no ellipsoids", 1: "true size"}
    return {
        labels.get(chosen, f"× {chosen}"): {
            "visible": [None] * fixed + [size == chosen for size in sizes for _ in range(sensors)]
        }
        for chosen in (0, *sizes)
    }

"""The 3-D view of the rig: sensor frames, fields of view, boards, and the uncertainty of positions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import (
    BLUE,
    BROWN,
    COLOR_CYCLE,
    GREEN,
    INK,
    MUTED,
    PINK,
    PURPLE,
    SCENE_AXIS,
    SKY,
    VERMILION,
    Chooser,
    choose_enlargement,
    escape_plotly,
    make_figure,
    render_figure,
)
from calgraph.result import Calibration, SensorPose
from calgraph.result.calibrated_cameras import calibrated_cameras
from calgraph.result.sensor_pose import choose_axis_length, error_ellipsoid
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS

Polyline = Array
"""(N, 3) points of one line, m."""


def frame_axes(T_root_sensor: Array, size: float) -> list[Polyline]:
    """The x, y and z axis as lines from the origin."""
    origin = T_root_sensor[:3, 3]
    return [np.stack([origin, origin + size * T_root_sensor[:3, i]]) for i in range(3)]


def camera_frustum(T_root_camera: Array, camera: CameraModel | None, depth: float) -> list[Polyline]:
    """The viewing frustum of a camera, without its lens distortion; 60° by 45° without intrinsics."""
    half = np.tan(np.radians([30.0, 22.5]))
    low, high = -half, half
    if camera is not None:
        focal, center = np.diag(camera.K)[:2], camera.K[:2, 2]
        size = np.array([camera.width, camera.height])
        # A fisheye's image plane reaches to infinity; it is clipped at 70° to each side.
        limit = np.tan(np.radians(70))
        low, high = np.clip(-center / focal, -limit, limit), np.clip((size - center) / focal, -limit, limit)
    corners = depth * np.array(
        [[low[0], low[1], 1], [high[0], low[1], 1], [high[0], high[1], 1], [low[0], high[1], 1]]
    )
    ring = se3.apply(T_root_camera, np.concatenate([corners, corners[:1]]))
    origin = T_root_camera[:3, 3]
    return [ring, *(np.stack([origin, corner]) for corner in ring[:4])]


def scan_circle(T_root_sensor: Array, radius: float, elevation: float = 0.0) -> Polyline:
    """The circle that a beam at an elevation (rad) describes about the sensor's z axis."""
    angles = np.linspace(0, 2 * np.pi, 49)
    c, s = np.cos(elevation), np.sin(elevation)
    circle = radius * np.stack([c * np.cos(angles), c * np.sin(angles), np.full_like(angles, s)], axis=-1)
    return se3.apply(T_root_sensor, circle)


def ellipsoid_mesh(center: Array, covariance: Array, exaggeration: float, limit: float) -> tuple[Array, Array]:
    """The 95 % ellipsoid of a position as a mesh.

    Args:
        center: (3,) m.
        covariance: (3, 3) m².
        exaggeration: factor on its size.
        limit: longest semi-axis, m; unobservable directions are clipped there.

    Returns:
        Vertices (N, 3) and triangles (M, 3) of indices.
    """
    half, R = error_ellipsoid(covariance)
    unit, triangles = _unit_sphere(12, 18)
    return center + (unit * np.minimum(exaggeration * half, limit)) @ R.T, triangles


def _unit_sphere(rows: int, columns: int) -> tuple[Array, Array]:
    """A unit sphere: vertices (N, 3) and triangles (M, 3)."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    vertices = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    triangles = np.stack([a, b, b + columns, a, b + columns, a + columns], axis=-1)
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)


# Smallest longest semi-axis of a visible ellipsoid, relative to the axes of a frame.
_MIN_VISIBLE = 0.25

Buttons = dict[str, dict[str, Any]]
"""Changes of the figure by the label of a button."""
_AXES = (("x", VERMILION), ("y", GREEN), ("z", BLUE))
_BEAM_ELEVATIONS = (-0.26, -0.09, 0.09, 0.26)
"""Elevations of the beams drawn for a 3-D LiDAR, rad."""
# Height of the figure, px; what it looks at in the scene's unit cube, and plotly's vertical angle of view.
_HEIGHT, _LOOK_AT, _VERTICAL_VIEW = 560, np.array([0.0, 0.0, -0.12]), np.pi / 4
# Of a name, px, and the places that it may have, with the direction to the name's middle (x right, y down).
_CHARACTER_WIDTH, _LINE_HEIGHT = 7.5, 16.0
_NAME_PLACES = {
    "top center": (0, -1), "bottom center": (0, 1), "middle right": (1, 0), "middle left": (-1, 0),
    "top right": (1, -1), "top left": (-1, -1), "bottom right": (1, 1), "bottom left": (-1, 1),
}  # fmt: skip
# Static points of all LiDARs of a network: more make browsers slow, and the file large.
_MAX_POINTS = 24_000


def render_rig_view(calibration: Calibration, rig: Rig) -> Markup:
    """The figure, with buttons for the view and for the enlargement of the uncertainties.

    Args:
        calibration: the result; of a network by :func:`calgraph.report.floor_view.place_on_plan`.
        rig: its configuration.
    """
    size = choose_axis_length(calibration.sensors, longest=2.0)
    # A hall is viewed from higher up, over its walls.
    eye = (0.95, -0.95, 0.95) if rig.is_network else (1.25, -1.25, 0.7)
    outlines = calibration.pictures.board_outlines
    of_rig = [
        *(_line_trace(
            f"{name} axes", [frame_axes(s.T_root_sensor, size)[i] for s in calibration.sensors], color, 5)
          for i, (name, color) in enumerate(_AXES)),
        _name_trace(calibration, size, eye),
        _line_trace("camera views", _camera_frustums(calibration, rig, size), PURPLE, 2),
        *_disc_traces(calibration, 1.8 * size),
        _line_trace("2-D scan planes", _scan_circles(calibration, "disc", 1.8 * size, (0.0,)), BROWN, 2),
        _line_trace(
            "3-D LiDAR beams", _scan_circles(calibration, "rings", 1.5 * size, _BEAM_ELEVATIONS), SKY, 2),
    ]  # fmt: skip
    around = [
        _line_trace("boards", [np.concatenate([o.corners, o.corners[:1]]) for o in outlines], MUTED, 1.5),
        *_hall_traces(calibration),
    ]
    of_rig, around = ([trace for trace in traces if len(trace["x"])] for traces in (of_rig, around))
    fixed = [*of_rig, *around]
    sensors = [s for s in calibration.sensors if s.parent is not None and np.any(s.measured_covariance[:3, :3])]
    limit, factor = 3 * size, _choose_enlargement(sensors, size)
    sizes = (1,) if factor == 1 else (1, factor)
    groups = [
        [_ellipsoid_trace(s, one, limit, one == factor) | {"showlegend": k == 0} for k, s in enumerate(sensors)]
        for one in sizes
    ]
    ellipsoids = [trace for group in groups for trace in group]
    layout = {
        "margin": {"l": 0, "r": 0, "t": 8, "b": 0},
        "legend": {"orientation": "h", "y": 0, "itemsizing": "constant"},
        "scene": _make_scene(calibration, size, eye),
    }
    labels = ("the sensors", "with walls and walks") if rig.is_network else ("the rig", "with the boards")
    view = _view_buttons(calibration, size, (len(of_rig), len(around)), labels)
    choosers, caption = [Chooser("What to show", view, int(rig.is_network))], ""
    if sensors:
        scale = "to scale" if factor == 1 else Markup("enlarged <b>{} ×</b>").format(factor)
        caption = Markup("Ellipsoids are drawn {}.").format(scale)
        choosers.append(
            Chooser("Size of the ellipsoids", _size_buttons(len(fixed), len(sensors), sizes), len(sizes))
        )
    return render_figure(
        "rig", make_figure([*fixed, *ellipsoids], **layout), _HEIGHT, "The rig in space", choosers, caption
    )


def _choose_enlargement(sensors: Sequence[SensorPose], size: float) -> int:
    """Smallest enlargement at which half of the ellipsoids are visible beside axes of a length, m."""
    covariances = [s.measured_covariance[:3, :3] for s in sensors if np.isfinite(s.measured_covariance).all()]
    if not covariances:
        return 1
    longest = float(np.median([error_ellipsoid(one)[0][-1] for one in covariances]))
    return choose_enlargement(longest, _MIN_VISIBLE * size)


def _line_trace(name: str, lines: Sequence[Polyline], color: str, width: float) -> dict[str, Any]:
    """Many lines as one trace, separated by null, which plotly does not draw."""
    points: list[list[float | None]] = []
    for line in lines:
        points += [*line.tolist(), [None, None, None]]
    x, y, z = zip(*points, strict=True) if points else ((), (), ())
    return {
        "type": "scatter3d", "mode": "lines", "name": name, "x": x, "y": y, "z": z,
        "line": {"color": color, "width": width}, "hoverinfo": "skip",
    }  # fmt: skip


def _name_trace(calibration: Calibration, size: float, eye: tuple[float, float, float]) -> dict[str, Any]:
    sensors = calibration.sensors
    origins = np.array([s.T_root_sensor[:3, 3] for s in sensors])
    low, high = np.transpose(_axis_ranges(calibration, size))
    # Names cover no axes, either.
    axes = np.concatenate(
        [line for s in sensors for end in (0.5, 1.0) for line in frame_axes(s.T_root_sensor, end * size)]
    )
    at, drawn = (_project((of - (low + high) / 2) / (high - low), np.array(eye)) for of in (origins, axes))
    return {
        "type": "scatter3d", "mode": "markers+text", "name": "sensors", "x": origins[:, 0].tolist(),
        "y": origins[:, 1].tolist(), "z": origins[:, 2].tolist(), "text": [s.name for s in sensors],
        # Text in the scene is plain; hover labels interpret tags.
        "customdata": [escape_plotly(s.name) for s in sensors],
        "textposition": _place_names([s.name for s in sensors], at, drawn), "marker": {"size": 4, "color": INK},
        "hovertemplate": "<b>%{customdata}</b><br>%{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>",
    }  # fmt: skip


def _project(points: Array, eye: Array) -> Array:
    """Pixels (N, 2) from the figure's middle, in the first view, of points (N, 3) of the scene's unit cube."""
    ahead = _LOOK_AT - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    viewed = (points - eye) @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return np.asarray(viewed[:, :2] / viewed[:, 2:] * _HEIGHT / 2 / np.tan(_VERTICAL_VIEW / 2))


def _place_names(names: Sequence[str], at: Array, drawn: Array) -> list[str]:
    """Where each name is, relative to its sensor at a pixel (N, 2): over no name, nor pixels (M, 2) drawn."""
    directions = np.array(list(_NAME_PLACES.values()))
    boxes = [(p, np.full(2, 6.0)) for p in drawn]
    chosen = []
    for name, p in zip(names, at, strict=True):
        half = np.array([_CHARACTER_WIDTH * len(name), _LINE_HEIGHT]) / 2
        centers = p + directions * (half + 6)
        sides = [np.maximum(half + other - np.abs(centers - middle), 0) for middle, other in boxes]
        best = int(np.argmin(np.prod(sides, axis=-1).sum(axis=0)))
        boxes.append((centers[best], half))
        chosen.append(list(_NAME_PLACES)[best])
    return chosen


def _camera_frustums(calibration: Calibration, rig: Rig, size: float) -> list[Polyline]:
    intrinsics = calibrated_cameras(calibration, rig)
    cameras = [s for s in calibration.sensors if KINDS[s.kind].shape == "frustum"]
    return [line for s in cameras for line in camera_frustum(s.T_root_sensor, intrinsics.get(s.name), 1.5 * size)]


def _scan_circles(
    calibration: Calibration, shape: str, radius: float, elevations: Sequence[float]
) -> list[Polyline]:
    sensors = [s for s in calibration.sensors if KINDS[s.kind].shape == shape]
    return [scan_circle(s.T_root_sensor, radius, e) for s in sensors for e in elevations]


def _disc_traces(calibration: Calibration, radius: float) -> list[dict[str, Any]]:
    """The scan planes as translucent discs."""
    discs = []
    for sensor in calibration.sensors:
        if KINDS[sensor.kind].shape == "disc":
            rim = scan_circle(sensor.T_root_sensor, radius)[:-1]
            x, y, z = np.concatenate([rim, sensor.T_root_sensor[None, :3, 3]]).T
            i = np.arange(len(rim))
            discs.append({
                "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": (i + 1) % len(rim),
                "k": np.full_like(i, len(rim)),
                "color": BROWN, "opacity": 0.1, "hoverinfo": "skip",
            })  # fmt: skip
    return discs


def _hall_traces(calibration: Calibration) -> list[dict[str, Any]]:
    """Static points of each LiDAR of a network up to the highest of them, without ceilings, and walks."""
    top = max(float(sensor.T_root_sensor[2, 3]) for sensor in calibration.sensors)
    step = sum(len(view.points) for view in calibration.pictures.floor_views) // _MAX_POINTS + 1
    names = [sensor.name for sensor in calibration.sensors]
    traces = []
    for view in calibration.pictures.floor_views:
        points = se3.apply(calibration[view.sensor].T_root_sensor, view.points[::step].astype(np.float64))
        x, y, z = points[points[:, 2] <= top].round(2).T
        color = COLOR_CYCLE[names.index(view.sensor) % len(COLOR_CYCLE)]
        shared = {"legendgroup": view.sensor, "hoverinfo": "skip"}
        traces.append({
            "type": "scatter3d", "mode": "markers", "name": escape_plotly(view.sensor), "x": x, "y": y, "z": z,
            "marker": {"size": 1.6, "color": color, "line": {"width": 0}}, **shared,
        })  # fmt: skip
        walks = [np.pad(walk, ((0, 0), (0, 1))) for walk in view.tracks]
        traces.append(_line_trace("walks", walks, color, 3) | {"showlegend": False, **shared})
    return traces


def _ellipsoid_trace(sensor: SensorPose, exaggeration: float, limit: float, visible: bool) -> dict[str, Any]:
    vertices, triangles = ellipsoid_mesh(
        sensor.T_root_sensor[:3, 3], sensor.measured_covariance[:3, :3], exaggeration, limit
    )
    x, y, z = vertices.T
    i, j, k = triangles.T
    return {
        "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "color": PINK, "opacity": 0.35,
        "visible": visible, "name": "position, 95 %", "legendgroup": "uncertainty", "flatshading": False,
        "text": escape_plotly(sensor.name), "hoverinfo": "text",
    }  # fmt: skip


def _make_scene(calibration: Calibration, size: float, eye: tuple[float, float, float]) -> dict[str, Any]:
    ranges = _axis_ranges(calibration, size)
    named = {f"{n}axis": {**SCENE_AXIS, "title": {"text": f"{n}, m"}, "range": r}
             for n, r in zip("xyz", ranges, strict=True)}  # fmt: skip
    return {
        **named,
        "aspectmode": "cube",
        "camera": {
            "eye": dict(zip("xyz", eye, strict=True)),
            "center": dict(zip("xyz", _LOOK_AT.tolist(), strict=True)),
        },
    }


def _axis_ranges(calibration: Calibration, size: float) -> list[list[float]]:
    """A cube around the rig, per axis, m: independent of the rig's proportions."""
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    low, high = origins.min(axis=0), origins.max(axis=0)
    half = float(np.max(high - low)) / 2 + 2 * size
    return [[float(middle - half), float(middle + half)] for middle in (low + high) / 2]


def _view_buttons(
    calibration: Calibration, size: float, counts: tuple[int, int], labels: tuple[str, str]
) -> Buttons:
    """The rig alone, with its number of traces, or everything, with those of what is around it."""
    ranges = zip("xyz", _axis_ranges(calibration, size), strict=True)
    rig = {f"{n}axis": {"range": r} for n, r in ranges}
    everything = {f"{n}axis": {"range": None, "autorange": True} for n in "xyz"}
    return {
        labels[0]: {
            "visible": [True] * counts[0] + [False] * counts[1],
            "layout": {"scene": {**rig, "aspectmode": "cube"}},
        },
        labels[1]: {"visible": [True] * sum(counts), "layout": {"scene": {**everything, "aspectmode": "data"}}},
    }


def _size_buttons(fixed: int, sensors: int, sizes: Sequence[int]) -> Buttons:
    """Buttons for the enlargement of the uncertainties, whose traces come last."""
    labels = {0: "no ellipsoids", 1: "true size"}
    return {
        labels.get(chosen, f"× {chosen}"): {
            "visible": [None] * fixed + [size == chosen for size in sizes for _ in range(sensors)]
        }
        for chosen in (0, *sizes)
    }

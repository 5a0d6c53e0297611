"""The fused cloud: points of the scanners in the colours of the camera images (MSG-Cal, Figures 1 and 6)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import (
    MUTED,
    ORANGE,
    SCENE_AXIS,
    VERMILION,
    escape_plotly,
    make_figure,
    render_buttons,
    render_figure,
)
from calgraph.result import BoardOutline, Calibration, Snapshot, calibrated_cameras, colorize_from_snapshots

# Largest numbers of captures, and of uncoloured points of each.
_MAX_CAPTURES, _MAX_GRAY_POINTS = 6, 2500
# Percentage of the coloured points inside the view, and its margin, m.
_INNER_PERCENT, _VIEW_MARGIN = 99, 0.3
# Range of the shown points as a multiple of the farthest board, and its minimum, m.
_RANGE_FACTOR, _MIN_RANGE = 2.5, 3.0
# Distance of the eye from the centre, in units of the scene.
_EYE_DISTANCE = 1.15


def render_fused_cloud(calibration: Calibration, rig: Rig) -> str:
    """The figure, with buttons for captures; empty where no camera image shows scanned points."""
    clouds = _colored_clouds(calibration, rig)
    if not clouds:
        return ""
    traces: list[dict[str, Any]] = []
    for k, (capture, (points, colors, colored)) in enumerate(clouds.items()):
        outlines = [o for o in calibration.pictures.board_outlines if o.capture == capture]
        traces += [trace | {"visible": k == 0} for trace in _cloud_traces(points, colors, colored, outlines)]
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    x, y, z = origins.T.round(4)
    sensors = {
        "type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "hoverinfo": "text",
        "text": [escape_plotly(s.name) for s in calibration.sensors],
        "marker": {"size": 5, "color": VERMILION}, "name": "sensors", "visible": True,
    }  # fmt: skip
    content = make_figure(
        [*traces, sensors],
        margin={"l": 0, "r": 0, "t": 8, "b": 0},
        showlegend=False,
        scene=_make_scene([points[colored] for points, _, colored in clouds.values()], origins),
    )
    each = len(traces) // len(clouds)
    choices = [
        {"visible": [*(j == k for j in range(len(clouds)) for _ in range(each)), None]} for k in range(len(clouds))
    ]
    buttons = render_buttons("fused", 0, "Capture", [f"capture {capture}" for capture in clouds], 0)
    share = np.mean(np.concatenate([colored for _, _, colored in clouds.values()]))
    about = (
        f"<p>Points of all scanners in one capture, in the colours of the camera images; grey points "
        f"({100 * (1 - share):.0f} %) are outside of all images. With a wrong pose, colours bleed over depth "
        f"edges: check the board, whose outline is its pose in the joint solution. The largest dots are the "
        f"sensors. Drag to rotate, scroll to zoom.</p>"
    )
    chart = render_figure(
        "fused", content | {"choices": [choices]}, 560, "Points of the scanners in the colours of the cameras"
    )
    return about + buttons + chart


Cloud = tuple[Array, NDArray[np.uint8], NDArray[np.bool_]]
"""Points (N, 3) in the root frame, m; their colours (N, 3), RGB; and a mask of those in view of a camera (N,)."""


def _colored_clouds(calibration: Calibration, rig: Rig) -> dict[int, Cloud]:
    """By capture, the coloured points of all scanners; of a few captures with detections of cameras and others."""
    poses = {s.name: s.T_root_sensor for s in calibration.sensors}
    cameras = calibrated_cameras(calibration, rig)
    by_capture: dict[int, list[Snapshot]] = {}
    for taken in calibration.pictures.snapshots:
        if taken.sensor in poses and (len(taken.points) or (taken.image and taken.sensor in cameras)):
            by_capture.setdefault(taken.capture, []).append(taken)
    both = [n for n, taken in by_capture.items() if 0 < sum(bool(s.image) for s in taken) < len(taken)]
    views = [view for view in calibration.pictures.board_views if view.used]
    pictured = Counter(view.capture for view in views if view.sensor in cameras)
    used = Counter(view.capture for view in views)
    # Most captures of a long recording are kept with few points only.
    full = [n for n in both if _count_points(by_capture[n]) >= 0.5 * max(map(_count_points, by_capture.values()))]
    best = sorted(sorted(full, key=lambda n: (-pictured[n], -used[n]))[:_MAX_CAPTURES])
    reach = _max_range(calibration, best)
    fused = {n: _fuse_points(by_capture[n], poses, reach) for n in best}
    clouds = {n: (x, *colorize_from_snapshots(x, by_capture[n], cameras, poses)) for n, x in fused.items()}
    return {n: cloud for n, cloud in clouds.items() if cloud[2].any()}


def _count_points(taken: Sequence[Snapshot]) -> int:
    return sum(len(s.points) for s in taken)


def _max_range(calibration: Calibration, captures: Sequence[int]) -> float:
    """How far from the root it is worth looking, m: what is far behind the boards would only make them small."""
    boards = [
        o.corners
        for o in calibration.pictures.board_outlines
        if o.capture in captures and np.isfinite(o.corners).all()
    ]
    if not boards:
        return np.inf
    return max(_RANGE_FACTOR * float(np.linalg.norm(np.concatenate(boards), axis=1).max()), _MIN_RANGE)


def _fuse_points(taken: Sequence[Snapshot], poses: Mapping[str, Array], reach: float) -> Array:
    """(N, 3) what scanners measured, root frame, m."""
    clouds = [se3.apply(poses[s.sensor], s.points.astype(np.float64)) for s in taken if len(s.points)]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    return np.asarray(points[np.linalg.norm(points, axis=1) < reach])


def _cloud_traces(
    points: Array, colors: NDArray[np.uint8], colored: NDArray[np.bool_], outlines: Sequence[BoardOutline]
) -> list[dict[str, Any]]:
    grey = points[~colored][:: int(np.sum(~colored)) // _MAX_GRAY_POINTS + 1]
    edge = [np.concatenate([o.corners, o.corners[:1], np.full((1, 3), np.nan)]) for o in outlines]
    return [
        _point_trace(grey, {"size": 1.2, "color": MUTED, "opacity": 0.5}),
        _point_trace(
            points[colored], {"size": 2.4, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colors[colored]]}
        ),
        _point_trace(np.concatenate([np.zeros((0, 3)), *edge]), {})
        | {"mode": "lines", "line": {"color": ORANGE, "width": 5}},
    ]


def _point_trace(points: Array, marker: dict[str, Any]) -> dict[str, Any]:
    x, y, z = points.round(3).T
    return {
        "type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "marker": marker | {"line": {"width": 0}},
        "hoverinfo": "skip",
    }  # fmt: skip


def _make_scene(colored: Sequence[Array], origins: Array) -> dict[str, Any]:
    """Axes around what is coloured and the sensors, with equal scales."""
    points = np.concatenate([*colored, origins])
    tail = (100 - _INNER_PERCENT) / 2
    low, high = np.percentile(points, [tail, 100 - tail], axis=0)
    low, high = (
        np.minimum(low, origins.min(axis=0)) - _VIEW_MARGIN,
        np.maximum(high, origins.max(axis=0)) + _VIEW_MARGIN,
    )
    axis = {**SCENE_AXIS, "color": MUTED}
    size = (high - low) / np.max(high - low)
    # From behind the sensors, above them, looking where the cameras do.
    ahead = (np.concatenate(colored).mean(axis=0) - origins.mean(axis=0)) / (high - low)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    eye = _EYE_DISTANCE * np.array([-ahead[0], -ahead[1], 0.6])
    return {
        **{
            f"{n}axis": {**axis, "title": {"text": f"{n}, m"}, "range": [low[i], high[i]]}
            for i, n in enumerate("xyz")
        },
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", (1.6 * size).tolist(), strict=True)),
        "camera": {"eye": dict(zip("xyz", eye.tolist(), strict=True)), "center": {"x": 0, "y": 0, "z": -0.1}},
    }

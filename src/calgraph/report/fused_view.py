"""The fused cloud: points of the scanners in the colours of the camera images (MSG-Cal, Figures 1 and 6).

Where no camera observes them, points of 3-D LiDARs are coloured by height, and those of 2-D scanners by scanner.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import (
    COLOR_CYCLE,
    INK,
    MUTED,
    ORANGE,
    SCENE_AXIS,
    Chooser,
    escape_plotly,
    make_figure,
    render_figure,
)
from calgraph.result import BoardOutline, Calibration, Snapshot, calibrated_cameras, colorize_from_snapshots
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS

# Largest numbers of captures, and of points that no camera observes of each scanner in one capture.
_MAX_CAPTURES, _MAX_OTHER_POINTS = 6, 2500
# Colours by height, and the percentage of points within their ends.
_HEIGHT_SCALE, _HEIGHT_PERCENT = "Viridis", 96
# Percentage of the coloured points inside the view, and its margin, m.
_INNER_PERCENT, _VIEW_MARGIN = 99, 0.3
# Range of the shown points as a multiple of the farthest board, and its minimum, m.
_RANGE_FACTOR, _MIN_RANGE = 2.5, 3.0
_CAPTION = """\
The others are coloured by height (3-D LiDAR, from dark to bright) or by scanner (2-D). With a wrong pose, image
colours bleed over depth edges, and walls of two scanners do not coincide: check the board, whose outline is its
pose in the joint solution. Corrected points are without the systematic errors of their scanners. Drag to rotate,
scroll to zoom, click in the legend to hide."""
# Distance of the eye from the centre, in units of the scene.
_EYE_DISTANCE = 1.15


def render_fused_cloud(calibration: Calibration, rig: Rig) -> Markup:
    """The figure, with buttons for captures; empty where no camera image shows scanned points."""
    kinds = {s.name: s.kind for s in calibration.sensors if KINDS[s.kind].measures_ranges}
    clouds = {f"capture {n}": (n, cloud) for n, cloud in _colored_clouds(calibration, rig).items()}
    if any(name in kinds and one.learned().parameters for name, one in calibration.corrections.items()):
        shown = {n for n, _ in clouds.values()}
        some = tuple(one for one in calibration.pictures.snapshots if one.capture in shown)
        few = replace(calibration, pictures=replace(calibration.pictures, snapshots=some))
        corrected = _colored_clouds(few.with_corrected_points(), rig)
        clouds |= {f"capture {n}, corrected": (n, cloud) for n, cloud in corrected.items()}
    if not clouds:
        return Markup()
    traces: list[dict[str, Any]] = []
    limits = _height_limits([cloud for _, cloud in clouds.values()], kinds)
    for k, (capture, cloud) in enumerate(clouds.values()):
        outlines = [o for o in calibration.pictures.board_outlines if o.capture == capture]
        traces += [trace | {"visible": k == 0} for trace in _cloud_traces(cloud, kinds, limits, outlines)]
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    x, y, z = origins.T.round(4)
    sensors = {
        "type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "hoverinfo": "text",
        "text": [escape_plotly(s.name) for s in calibration.sensors],
        "marker": {"size": 5, "color": INK}, "name": "sensors", "visible": True,
    }  # fmt: skip
    content = make_figure(
        [*traces, sensors],
        margin={"l": 0, "r": 0, "t": 8, "b": 0},
        legend={"orientation": "h", "y": 0, "itemsizing": "constant"},
        scene=_make_scene(
            [part.points[part.colored] for _, cloud in clouds.values() for part in cloud.values()], origins
        ),
    )
    each = len(traces) // len(clouds)
    choices = {
        label: {"visible": [*(j == k for j in range(len(clouds)) for _ in range(each)), None]}
        for k, label in enumerate(clouds)
    }
    share = np.mean(np.concatenate([part.colored for _, cloud in clouds.values() for part in cloud.values()]))
    about = f"{100 * share:.0f} % of the points are in the image of a camera and have its colours. {_CAPTION}"
    about_picture = "Points of the scanners in the colours of the cameras"
    return render_figure("fused", content, 560, about_picture, [Chooser("Capture", choices, 0)], about)


@dataclass(frozen=True, eq=False)
class _ColoredPoints:
    """Points of one scanner in one capture."""

    points: Array
    """(N, 3) root frame, m."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB."""
    colored: NDArray[np.bool_]
    """(N,) whether a camera observes them."""


_Cloud = Mapping[str, _ColoredPoints]
"""Points by scanner."""


def _colored_clouds(calibration: Calibration, rig: Rig) -> dict[int, _Cloud]:
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
    clouds = {n: _color_points(by_capture[n], cameras, poses, reach) for n in best}
    return {n: cloud for n, cloud in clouds.items() if any(part.colored.any() for part in cloud.values())}


def _color_points(
    taken: Sequence[Snapshot], cameras: Mapping[str, CameraModel], poses: Mapping[str, Array], reach: float
) -> _Cloud:
    """The points of each scanner up to a distance from the root, m, with the colours of simultaneous images."""
    scans = {s.sensor: se3.apply(poses[s.sensor], s.points.astype(np.float64)) for s in taken if len(s.points)}
    near = {name: points[np.linalg.norm(points, axis=1) < reach] for name, points in scans.items()}
    # The points of all scanners jointly: each occludes points behind it in the cameras.
    together = np.concatenate([np.zeros((0, 3)), *near.values()])
    found = colorize_from_snapshots(together, taken, cameras, poses)
    cuts = np.cumsum([len(points) for points in near.values()])[:-1]
    colors, colored = (np.split(one, cuts) for one in found)
    return {name: _ColoredPoints(*part) for name, *part in zip(near, near.values(), colors, colored, strict=True)}


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


def _height_limits(clouds: Sequence[_Cloud], kinds: Mapping[str, str]) -> tuple[float, float]:
    """Heights between which the colours of 3-D LiDARs change, m."""
    heights = [
        part.points[~part.colored, 2]
        for cloud in clouds
        for name, part in cloud.items()
        if KINDS[kinds[name]].detects == "plane"
    ]
    tail = (100 - _HEIGHT_PERCENT) / 2
    together = np.concatenate([np.zeros(1), *heights])
    low, high = np.percentile(together, [tail, 100 - tail]).tolist()
    return low, high


def _cloud_traces(
    cloud: _Cloud, kinds: Mapping[str, str], height: tuple[float, float], outlines: Sequence[BoardOutline]
) -> list[dict[str, Any]]:
    """Points in images, the others of each scanner, and boards: as many traces for each capture."""
    edge = [np.concatenate([o.corners, o.corners[:1], np.full((1, 3), np.nan)]) for o in outlines]
    none = np.zeros((0, 3))
    visible = np.concatenate([none, *(part.points[part.colored] for part in cloud.values())])
    digits = b"".join(part.colors[part.colored].tobytes() for part in cloud.values()).hex()
    colors = [f"#{digits[i : i + 6]}" for i in range(0, len(digits), 6)]
    others = []
    for k, (name, kind) in enumerate(kinds.items()):
        points = cloud[name].points[~cloud[name].colored] if name in cloud else none
        points = points[:: len(points) // _MAX_OTHER_POINTS + 1]
        marker: dict[str, Any] = {"size": 2.4, "color": COLOR_CYCLE[k % len(COLOR_CYCLE)]}
        if KINDS[kind].detects == "plane":
            marker = {"size": 1.8, "color": points[:, 2].round(2), "colorscale": _HEIGHT_SCALE,
                      "cmin": height[0], "cmax": height[1]}  # fmt: skip
        others.append(_point_trace(points, marker) | {"name": escape_plotly(name), "showlegend": len(points) > 0})
    return [
        _point_trace(visible, {"size": 2.4, "color": colors}) | {"name": "in an image", "showlegend": True},
        *others,
        _point_trace(np.concatenate([none, *edge]), {})
        | {"mode": "lines", "line": {"color": ORANGE, "width": 5}, "name": "board", "showlegend": True},
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

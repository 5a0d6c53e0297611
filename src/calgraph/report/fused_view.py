"""The fused cloud: what scanners measured, in the colours that the cameras saw (MSG-Cal, Figures 1 and 6)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import MUTED, ORANGE, PAPER, RULE, VERMILION, chooser, figure, placed, plotly_text
from calgraph.result import BoardOutline, Calibration, Snapshot, calibrated_cameras, colorize_from_snapshots

# Captures that can be chosen, and points of each that no camera sees: they only show where the others are.
_MOST, _GREY = 6, 2500
# The view holds so much of the coloured points, in percent, and this around it, m.
_INNER, _AROUND = 99, 0.3
# What is shown reaches so many times as far as the boards, and so far at least, m.
_BEHIND, _AT_LEAST = 2.5, 3.0
# Of the eye from the middle, in the units of the scene.
_DISTANCE = 1.15


def fused_view(calibration: Calibration, rig: Rig) -> str:
    """The figure, with a choice of captures; nothing where no camera pictures what a scanner measured."""
    clouds = _clouds(calibration, rig)
    if not clouds:
        return ""
    traces: list[dict[str, Any]] = []
    for k, (capture, (points, colors, seen)) in enumerate(clouds.items()):
        outlines = [o for o in calibration.pictures.board_outlines if o.capture == capture]
        traces += [trace | {"visible": k == 0} for trace in _traces(points, colors, seen, outlines)]
    origins = np.array([s.T_root_sensor[:3, 3] for s in calibration.sensors])
    x, y, z = origins.T.round(4)
    sensors = {
        "type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "hoverinfo": "text",
        "text": [plotly_text(s.name) for s in calibration.sensors],
        "marker": {"size": 5, "color": VERMILION}, "name": "sensors", "visible": True,
    }  # fmt: skip
    content = figure(
        [*traces, sensors],
        margin={"l": 0, "r": 0, "t": 8, "b": 0},
        showlegend=False,
        scene=_scene([points[seen] for points, _, seen in clouds.values()], origins),
    )
    each = len(traces) // len(clouds)
    choices = [
        {"visible": [*(j == k for j in range(len(clouds)) for _ in range(each)), None]} for k in range(len(clouds))
    ]
    buttons = chooser("fused", 0, "Capture", [f"capture {capture}" for capture in clouds], 0)
    share = np.mean(np.concatenate([seen for _, _, seen in clouds.values()]))
    about = (
        f"<p>Points of all scanners in one capture, in the colours of the cameras' pictures; grey ones no camera "
        f"sees ({100 * (1 - share):.0f} %). Where a pose is wrong, colours run over edges: look at the board, "
        f"outlined where the joint solution has it. The largest dots are the sensors. Drag to turn, "
        f"scroll to zoom.</p>"
    )
    picture = placed(
        "fused", content | {"choices": [choices]}, 560, "Points of the scanners in the colours of the cameras"
    )
    return about + buttons + picture


Cloud = tuple[Array, NDArray[np.uint8], NDArray[np.bool_]]
"""Points (N, 3) in the root frame, m; their colours (N, 3), RGB; and which of them a camera sees (N,)."""


def _clouds(calibration: Calibration, rig: Rig) -> dict[int, Cloud]:
    """By capture, the coloured points of all scanners; of a few in which cameras and others saw the board."""
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
    full = [n for n in both if _detail(by_capture[n]) >= 0.5 * max(map(_detail, by_capture.values()))]
    best = sorted(sorted(full, key=lambda n: (-pictured[n], -used[n]))[:_MOST])
    reach = _reach(calibration, best)
    fused = {n: _fused(by_capture[n], poses, reach) for n in best}
    clouds = {n: (x, *colorize_from_snapshots(x, by_capture[n], cameras, poses)) for n, x in fused.items()}
    return {n: cloud for n, cloud in clouds.items() if cloud[2].any()}


def _detail(taken: Sequence[Snapshot]) -> int:
    return sum(len(s.points) for s in taken)


def _reach(calibration: Calibration, captures: Sequence[int]) -> float:
    """How far from the root it is worth looking, m: what is far behind the boards would only make them small."""
    boards = [
        o.corners
        for o in calibration.pictures.board_outlines
        if o.capture in captures and np.isfinite(o.corners).all()
    ]
    if not boards:
        return np.inf
    return max(_BEHIND * float(np.linalg.norm(np.concatenate(boards), axis=1).max()), _AT_LEAST)


def _fused(taken: Sequence[Snapshot], poses: Mapping[str, Array], reach: float) -> Array:
    """(N, 3) what scanners measured, root frame, m."""
    clouds = [se3.apply(poses[s.sensor], s.points.astype(np.float64)) for s in taken if len(s.points)]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    return np.asarray(points[np.linalg.norm(points, axis=1) < reach])


def _traces(
    points: Array, colors: NDArray[np.uint8], seen: NDArray[np.bool_], outlines: Sequence[BoardOutline]
) -> list[dict[str, Any]]:
    grey = points[~seen][:: int(np.sum(~seen)) // _GREY + 1]
    edge = [np.concatenate([o.corners, o.corners[:1], np.full((1, 3), np.nan)]) for o in outlines]
    return [
        _dots(grey, {"size": 1.2, "color": MUTED, "opacity": 0.5}),
        _dots(points[seen], {"size": 2.4, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colors[seen]]}),
        _dots(np.concatenate([np.zeros((0, 3)), *edge]), {})
        | {"mode": "lines", "line": {"color": ORANGE, "width": 5}},
    ]


def _dots(points: Array, marker: dict[str, Any]) -> dict[str, Any]:
    x, y, z = points.round(3).T
    return {
        "type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "marker": marker | {"line": {"width": 0}},
        "hoverinfo": "skip",
    }  # fmt: skip


def _scene(seen: Sequence[Array], origins: Array) -> dict[str, Any]:
    """Axes around what is coloured and the sensors, with equal scales."""
    points = np.concatenate([*seen, origins])
    tail = (100 - _INNER) / 2
    low, high = np.percentile(points, [tail, 100 - tail], axis=0)
    low, high = np.minimum(low, origins.min(axis=0)) - _AROUND, np.maximum(high, origins.max(axis=0)) + _AROUND
    axis = {
        "backgroundcolor": PAPER,
        "gridcolor": RULE,
        "zerolinecolor": RULE,
        "showspikes": False,
        "color": MUTED,
    }
    size = (high - low) / np.max(high - low)
    # From behind the sensors, above them, looking where the cameras do.
    ahead = (np.concatenate(seen).mean(axis=0) - origins.mean(axis=0)) / (high - low)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    eye = _DISTANCE * np.array([-ahead[0], -ahead[1], 0.6])
    return {
        **{
            f"{n}axis": {**axis, "title": {"text": f"{n}, m"}, "range": [low[i], high[i]]}
            for i, n in enumerate("xyz")
        },
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", (1.6 * size).tolist(), strict=True)),
        "camera": {"eye": dict(zip("xyz", eye.tolist(), strict=True)), "center": {"x": 0, "y": 0, "z": -0.1}},
    }

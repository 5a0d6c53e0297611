"""The coverage of each sensor's field of view as a figure and as text."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.formatting import format_count, format_fixed
from calgraph.report.templates import render
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, DriveView, Pictures, SensorPose
from calgraph.result.calibrated_cameras import calibrated_cameras
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS

# Axes x forward, y to the left, z up of a frame with x to the right, y down, z forward.
_OPTICAL_TO_LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Cells along a camera's longer side, of the azimuth, and of elevations and ranges.
_CAMERA_COLUMNS, _AZIMUTH_BINS, _ROW_COUNT = 20, 72, 12
# Parts by which gaps are described: sectors of the azimuth, degrees, and thirds of an image.
_SECTOR_WIDTH = 30
_THIRDS = (("left", "middle", "right"), ("top", "centre", "bottom"))
# Points beyond this percentile are not counted to the field of view, percent.
_TAIL_PERCENT = 0.5
# Of the middle of people over the floor, m.
_BODY_HEIGHT = 0.9


@dataclass(frozen=True, eq=False)
class Coverage:
    """Number of captures, walks or seconds with the target in each cell of a field of view."""

    x_edges: Array
    """(C + 1,) px, or degrees of azimuth, from the left to the right as viewed by the sensor."""
    y_edges: Array
    """(R + 1,) px, degrees of elevation, or metres, from the top to the bottom of the image."""
    counts: Array
    """(R, C) captures or walks that reached into each cell."""
    visible: NDArray[np.bool_]
    """(C,) columns inside the sensor's field of view."""
    axes: tuple[str, str]
    """Quantity and unit of x and y."""
    remarks: tuple[str, ...]
    """Description of the coverage and of its gaps."""


def compute_coverage(calibration: Calibration, rig: Rig, sensor: SensorPose) -> Coverage | None:
    """Coverage of one sensor's field of view; None where the result has no detections of it."""
    own, kind = calibration.pictures.of_sensor(sensor.name), KINDS[sensor.kind]
    # Those that were used; all if none was used.
    views = _finite_points(view.measured for view in own.board_views if view.used)
    views = views or _finite_points(view.measured for view in own.board_views)
    if kind.detects == "corners":
        camera = calibrated_cameras(calibration, rig).get(sensor.name)
        return _camera_coverage(own, sensor, camera, views) if camera and views else None
    if calibration.pictures.floor_views:
        return _walk_coverage(own, sensor)
    subject, field = "The board was", _finite_points(one.points.astype(np.float64) for one in own.snapshots)
    if own.drive_paths:
        subject, (views, field) = "Common surfaces were", _surface_points(own.drive_views)
    if not views:
        return None
    if kind.optical:
        views, field = ([points @ _OPTICAL_TO_LEVEL.T for points in of] for of in (views, field))
    if kind.detects == "line":
        return _planar_coverage(views, [*field, *views], subject)
    return _lidar_coverage(views, [*field, *views], subject)


def _walk_coverage(own: Pictures, sensor: SensorPose) -> Coverage | None:
    """Coverage of a scanner of a network by people; None without any."""
    T_sensor_plan = se3.inverse(own.T_plan_root @ sensor.T_root_sensor)

    def place(points: Array, height: float) -> Array:
        """(N, 3) in the scanner's frame of points (N, 2) at a height in the plan."""
        return se3.apply(T_sensor_plan, np.column_stack([points, np.full(len(points), height)]))

    solid = KINDS[sensor.kind].detects == "plane"
    height = _BODY_HEIGHT if solid else 0.0
    walks = _finite_points(place(walk, height) for view in own.floor_views for walk in view.tracks)
    if not walks:
        return None
    if solid:
        static = _finite_points(view.points.astype(np.float64) for view in own.floor_views)
        return _lidar_coverage(walks, [*static, *walks], "People walked")
    background = _finite_points(place(view.background, 0.0) for view in own.floor_views)
    return _planar_coverage(walks, [*background, *walks], "People walked")


def _surface_points(views: Sequence[DriveView]) -> tuple[list[Array], list[Array]]:
    """Points of a drive on surfaces that another sensor measured, by second, and all on surfaces."""
    seconds: list[Array] = []
    field = [view.points.astype(np.float64) for view in views]
    for view, points in zip(views, field, strict=True):
        second = np.floor(view.times[view.shared])
        seconds += [points[view.shared][second == one] for one in np.unique(second)]
    return _finite_points(seconds), _finite_points(field)


def _finite_points(clouds: Iterable[Array]) -> list[Array]:
    """The finite points of each array (N, k), without empty arrays."""
    finite = (points[np.isfinite(points).all(axis=1)] for points in clouds)
    return [points for points in finite if len(points)]


def _camera_coverage(own: Pictures, sensor: SensorPose, camera: CameraModel, views: Sequence[Array]) -> Coverage:
    size = np.array([camera.width, camera.height])
    rows, columns = np.maximum(np.round(_CAMERA_COLUMNS * size[::-1] / size.max()), 1).astype(int)
    x, y = (np.linspace(-0.5, length - 0.5, n + 1) for length, n in zip(size, (columns, rows), strict=True))
    thirds = _count_views(views, *(np.linspace(-0.5, length - 0.5, 4) for length in size))
    empty = [f"{_THIRDS[1][i]} {_THIRDS[0][j]}" for i, j in np.argwhere(thirds == 0)]
    missing = "There were corners in all parts of the image."
    if empty:
        missing = f"Missing: no corners in the {_join_words(empty)} of the image."
    remarks = (missing, *_describe_board_poses(own, sensor))
    return Coverage(x, y, _count_views(views, x, y), np.ones(columns, dtype=np.bool_), ("px", "px"), remarks)


def _describe_board_poses(own: Pictures, sensor: SensorPose) -> tuple[str, ...]:
    """Distance and tilt of the boards that a camera detected."""
    captures = {view.capture for view in own.board_views if view.used}
    corners = [o.corners for o in own.board_outlines if o.capture in captures and o.board is not None]
    if not corners:
        return ()
    boards = se3.apply(se3.inverse(sensor.T_root_sensor), np.concatenate(corners)).reshape(-1, 4, 3)
    center, normal = boards.mean(axis=1), np.cross(boards[:, 1] - boards[:, 0], boards[:, 3] - boards[:, 0])
    distance = np.linalg.norm(center, axis=1)
    cosine = np.abs(np.sum(center * normal, axis=1)) / (distance * np.linalg.norm(normal, axis=1))
    tilt = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    return (
        f"The board was {_format_interval(distance, 1)} m away, tilted {_format_interval(tilt, 0)}° from the "
        "viewing direction.",
    )


def _lidar_coverage(views: Sequence[Array], field: Sequence[Array], subject: str) -> Coverage:
    low, high = np.percentile(_elevations(np.concatenate(field)), [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    margin = max(0.02 * (high - low), 0.5)
    heights = [_elevations(view) for view in views]
    covered = _format_interval(np.concatenate(heights), 0)
    remark = f"Covered elevations: {covered}° of {_format_interval(np.array([low, high]), 0)}°."
    edges = np.linspace(high + margin, low - margin, _ROW_COUNT + 1)
    return _scanner_coverage(views, field, subject, heights, edges, "elevation, °", remark)


def _planar_coverage(views: Sequence[Array], field: Sequence[Array], subject: str) -> Coverage:
    ranges = [_distances_from_origin(view) for view in views]
    edges = np.linspace(1.1 * max(map(np.max, ranges)), 0, _ROW_COUNT + 1)
    return _scanner_coverage(views, field, subject, ranges, edges, "range, m")


def _scanner_coverage(
    views: Sequence[Array], field: Sequence[Array], subject: str, y: Sequence[Array], y_edges: Array, y_axis: str,
    *remarks: str,
) -> Coverage:  # fmt: skip
    """Coverage by azimuth and a second quantity ``y`` of the points of each view."""
    azimuth = np.linspace(180, -180, _AZIMUTH_BINS + 1)
    cells = [np.column_stack([_azimuths(view), values]) for view, values in zip(views, y, strict=True)]
    visible = np.histogram(-_azimuths(np.concatenate(field)), -azimuth)[0] > 0
    distances = _format_interval(_distances_from_origin(np.concatenate(views)), 1)
    return Coverage(
        azimuth, y_edges, _count_views(cells, azimuth, y_edges), visible, ("azimuth, °", y_axis),
        (*_describe_sectors(views, field, subject), *remarks, f"{subject} {distances} m away."),
    )  # fmt: skip


def _count_views(views: Sequence[Array], x_edges: Array, y_edges: Array) -> Array:
    """(R, C) number of views (N, 2) with a point in each cell; edges may descend."""
    points = np.concatenate(views)
    x, y = (_find_bins(along, edges) for along, edges in zip(points.T, (x_edges, y_edges), strict=True))
    view = np.repeat(np.arange(len(views)), [len(one) for one in views])
    inside = (x >= 0) & (x < len(x_edges) - 1) & (y >= 0) & (y < len(y_edges) - 1)
    hit = np.zeros((len(views), len(y_edges) - 1, len(x_edges) - 1), dtype=np.bool_)
    hit[view[inside], y[inside], x[inside]] = True
    return np.asarray(hit.sum(axis=0), dtype=np.float64)


def _find_bins(values: Array, edges: Array) -> NDArray[np.intp]:
    """The bin of each value, of which the last one has both edges; -1, or one too many, where it is outside."""
    sign = np.sign(edges[-1] - edges[0])
    bins = np.searchsorted(sign * edges, sign * values, side="right") - 1
    return np.asarray(bins - (values == edges[-1]))


def _azimuths(points: Array) -> Array:
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def _elevations(points: Array) -> Array:
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def _distances_from_origin(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points, axis=1))


def _describe_sectors(views: Sequence[Array], field: Sequence[Array], subject: str) -> tuple[str, ...]:
    """Covered fraction of the scanner's azimuths, and the sectors that are not covered."""
    edges = np.arange(-180, 181, _SECTOR_WIDTH)
    covered, visible = (np.histogram(_azimuths(np.concatenate(of)), edges)[0] > 0 for of in (views, field))
    missing = np.flatnonzero(visible & ~covered)
    if not len(missing):
        return (f"{subject} in all directions of the field of view.",)
    # Neighbouring sectors are merged, also across ±180°: counted from one that is not missing.
    turn = int(np.flatnonzero(~(visible & ~covered))[0]) if len(missing) < len(covered) else 0
    order = sorted((int(k) - turn) % len(covered) for k in missing)
    runs = [list(run) for _, run in groupby(enumerate(order), key=lambda one: one[1] - one[0])]
    spans = [_format_sector(edges[0] + _SECTOR_WIDTH * (run[0][1] + turn), len(run)) for run in runs]
    share = round(100 * int(np.sum(covered & visible)) / int(np.sum(visible)))
    return (f"{subject} in {share} % of the directions of the field of view. Missing: {_join_words(spans)}.",)


def _format_sector(start: int, count: int) -> str:
    """An interval of azimuths, counter-clockwise from the front, with its main direction."""
    low, high = ((start + 180) % 360) - 180, ((start + _SECTOR_WIDTH * count + 179) % 360) - 179
    middle = ((start + _SECTOR_WIDTH * count / 2 + 180) % 360) - 180
    names = ("ahead", "to the left", "behind", "to the right")
    return f"{format_fixed(low, 0)}° to {format_fixed(high, 0)}° ({names[round(middle / 90) % 4]})"


def _format_interval(values: Array, decimals: int) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{format_fixed(low, decimals)}{'–' if low >= 0 else ' to '}{format_fixed(high, decimals)}"


def _join_words(things: Sequence[str]) -> str:
    return things[0] if len(things) == 1 else f"{', '.join(things[:-1])} and {things[-1]}"


# Sizes of the drawing and of its margins for labels, px.
_WIDTH, _HEIGHT, _LEFT = 340, 230, 44
_TICKS = 5


def render_coverage(calibration: Calibration, rig: Rig, words: Vocabulary) -> Markup:
    """A figure for each sensor; a sentence where the result has no detections."""
    found = {sensor: compute_coverage(calibration, rig, sensor) for sensor in calibration.sensors}
    return render(
        "coverage.html",
        words=words,
        width=_WIDTH,
        left=_LEFT,
        shown=[(sensor.name, one, _draw_cells(one, words.item)) for sensor, one in found.items() if one],
        without=[f"{s.name} ({KINDS[s.kind].title})" for s, one in found.items() if not one],
    )


def _draw_cells(of: Coverage, noun: str) -> dict[str, Any]:
    """Places in the drawing, px: the cells, darker with more captures, on the field of view, and ticks."""
    rows, columns = of.counts.shape
    height = min(_WIDTH * rows / columns, _HEIGHT) if of.axes[0] == "px" else 0.5 * _HEIGHT + 20
    w, h = _WIDTH / columns, height / rows
    most = max(float(of.counts.max()), 1.0)
    # Neighbouring visible columns are one rectangle, which avoids seams.
    turns = np.flatnonzero(np.diff(np.concatenate([[0], of.visible.astype(int), [0]]))).reshape(-1, 2)
    return {
        "height": height,
        "cell": (w, h),
        "cells": [
            (
                _LEFT + j * w,
                8 + i * h,
                0.15 + 0.85 * np.log1p(n) / np.log1p(most),
                f"{_format_bin(of.x_edges, j)} {of.axes[0]}, {_format_bin(of.y_edges, i)} {of.axes[1]}: "
                f"{format_count(int(n), noun)}",
            )
            for (i, j), n in np.ndenumerate(of.counts)
            if n
        ],
        "field": [(_LEFT + first * w, (last - first) * w) for first, last in turns.tolist()],
        "x_ticks": [(share, _format_tick(of.x_edges, share)) for share in np.linspace(0, 1, _TICKS)],
        "y_ticks": [(share, _format_tick(of.y_edges, share)) for share in (0.0, 0.5, 1.0)],
    }


def _format_tick(edges: np.ndarray[tuple[int], np.dtype[np.float64]], share: float) -> str:
    decimals = 0 if abs(edges[-1] - edges[0]) > 20 else 1
    return format_fixed(float(edges[0] + share * (edges[-1] - edges[0])), decimals)


def _format_bin(edges: np.ndarray[tuple[int], np.dtype[np.float64]], k: int) -> str:
    low, high = sorted((float(edges[k]), float(edges[k + 1])))
    return f"{low:.4g} to {high:.4g}".replace("-", "−")

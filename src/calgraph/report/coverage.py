"""Which part of each sensor's field of view the target was in, and in words what is missing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.formatting import fixed
from calgraph.result import Calibration, SensorPose
from calgraph.result.used_intrinsics import calibrated_cameras
from calgraph.sensors import CameraModel

# Cells of a camera's longer side, of a turn, and of elevations and ranges.
_COLUMNS, _AZIMUTHS, _ROWS = 20, 72, 12
# Fields of view in words: so wide are the parts that a circle and a picture are divided into.
_SECTOR = 30
_THIRDS = (("left", "middle", "right"), ("top", "centre", "bottom"))
# The edge of a field of view beyond a few stray points, percent.
_TAIL = 0.5


@dataclass(frozen=True, eq=False)
class Coverage:
    """How often the target was seen in each cell of a field of view."""

    x_edges: Array
    """(C + 1,) px, or degrees of azimuth, from the left to the right as the sensor sees it."""
    y_edges: Array
    """(R + 1,) px, degrees of elevation, or metres, from the top to the bottom of the picture."""
    counts: Array
    """(R, C) captures or walks that reached into each cell."""
    visible: NDArray[np.bool_]
    """(C,) in which columns the sensor sees anything at all."""
    axes: tuple[str, str]
    """What x and y are."""
    remarks: tuple[str, ...]
    """What it comes to, and what is missing."""


def coverage(calibration: Calibration, rig: Rig, sensor: SensorPose) -> Coverage | None:
    """Where one sensor saw the target; None where that is not known."""
    if sensor.kind == "camera":
        camera = calibrated_cameras(calibration, rig).get(sensor.name)
        views = _seen(calibration, sensor)
        return _of_camera(calibration, sensor, camera, views) if camera and views else None
    if calibration.pictures.floor_views:
        walks = _walks(calibration, sensor)
        field = _background(calibration, sensor)
        return _of_scanner(walks, [*field, *walks], "Somebody walked") if walks else None
    views, field = _seen(calibration, sensor), _field(calibration, sensor)
    if not views:
        return None
    if sensor.kind == "lidar2d":
        return _of_scanner(views, [*field, *views], "The board was")
    return _of_lidar(views, [*field, *views])


def _seen(calibration: Calibration, sensor: SensorPose) -> list[Array]:
    """What was used of what the sensor saw of boards: of all, if it has no part in the solution."""
    own = [view for view in calibration.pictures.board_views if view.sensor == sensor.name]
    return _finite(view.measured for view in own if view.used) or _finite(view.measured for view in own)


def _field(calibration: Calibration, sensor: SensorPose) -> list[Array]:
    return _finite(s.points.astype(np.float64) for s in calibration.pictures.snapshots if s.sensor == sensor.name)


def _walks(calibration: Calibration, sensor: SensorPose) -> list[Array]:
    """Where a scanner of a network saw people, in its frame."""
    views = [view for view in calibration.pictures.floor_views if view.sensor == sensor.name]
    return _finite(_in_sensor(walk, sensor) for view in views for walk in view.tracks)


def _background(calibration: Calibration, sensor: SensorPose) -> list[Array]:
    views = [view for view in calibration.pictures.floor_views if view.sensor == sensor.name]
    return _finite(_in_sensor(view.background, sensor) for view in views)


def _finite(seen: Iterable[Array]) -> list[Array]:
    """The finite ones of points (N, k) each, where there are any."""
    finite = (points[np.isfinite(points).all(axis=1)] for points in seen)
    return [points for points in finite if len(points)]


def _in_sensor(points: Array, sensor: SensorPose) -> Array:
    """(N, 3) in a scanner's frame of points (N, 2) on the floor."""
    return se3.apply(se3.inverse(sensor.T_root_sensor), np.column_stack([points, np.zeros(len(points))]))


def _of_camera(
    calibration: Calibration, sensor: SensorPose, camera: CameraModel, views: Sequence[Array]
) -> Coverage:
    size = np.array([camera.width, camera.height])
    rows, columns = np.maximum(np.round(_COLUMNS * size[::-1] / size.max()), 1).astype(int)
    x, y = (np.linspace(-0.5, length - 0.5, n + 1) for length, n in zip(size, (columns, rows), strict=True))
    thirds = _counts(views, *(np.linspace(-0.5, length - 0.5, 4) for length in size))
    empty = [f"{_THIRDS[1][i]} {_THIRDS[0][j]}" for i, j in np.argwhere(thirds == 0)]
    missing = (
        f"Missing: no corners in the {_listed(empty)} of the picture."
        if empty
        else "There were corners in all parts of the picture."
    )
    return Coverage(
        x,
        y,
        _counts(views, x, y),
        np.ones(columns, dtype=np.bool_),
        ("px", "px"),
        (missing, *_distances(calibration, sensor)),
    )


def _distances(calibration: Calibration, sensor: SensorPose) -> tuple[str, ...]:
    """From how far, and how much tilted, a camera saw boards."""
    seen = {view.capture for view in calibration.pictures.board_views if view.sensor == sensor.name and view.used}
    corners = [o.corners for o in calibration.pictures.board_outlines if o.capture in seen and o.board is not None]
    if not corners:
        return ()
    boards = se3.apply(se3.inverse(sensor.T_root_sensor), np.concatenate(corners)).reshape(-1, 4, 3)
    center, normal = boards.mean(axis=1), np.cross(boards[:, 1] - boards[:, 0], boards[:, 3] - boards[:, 0])
    distance = np.linalg.norm(center, axis=1)
    cosine = np.abs(np.sum(center * normal, axis=1)) / (distance * np.linalg.norm(normal, axis=1))
    tilt = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    return (
        f"The board was {_span(distance, 1)} m away, and its face turned by {_span(tilt, 0)}° from the sight.",
    )


def _of_lidar(views: Sequence[Array], field: Sequence[Array]) -> Coverage:
    azimuth = np.linspace(180, -180, _AZIMUTHS + 1)
    low, high = np.percentile(_elevation(np.concatenate(field)), [_TAIL, 100 - _TAIL])
    margin = max(0.02 * (high - low), 0.5)
    elevation = np.linspace(high + margin, low - margin, _ROWS + 1)
    cells = [np.column_stack([_azimuth(view), _elevation(view)]) for view in views]
    heights = np.concatenate([cell[:, 1] for cell in cells])
    tall = f"Of its elevations, {_span(np.array([low, high]), 0)}°, the board was in {_span(heights, 0)}°."
    remarks = (*_sectors(views, field, "The board was"), tall, _ranges(views, "The board was"))
    return Coverage(
        azimuth,
        elevation,
        _counts(cells, azimuth, elevation),
        _looks(field, azimuth),
        ("azimuth, °", "elevation, °"),
        remarks,
    )


def _of_scanner(views: Sequence[Array], field: Sequence[Array], what: str) -> Coverage:
    azimuth = np.linspace(180, -180, _AZIMUTHS + 1)
    farthest = 1.1 * max(float(np.max(_range(view))) for view in views)
    ranges = np.linspace(farthest, 0, _ROWS + 1)
    cells = [np.column_stack([_azimuth(view), _range(view)]) for view in views]
    remarks = (*_sectors(views, field, what), _ranges(views, what))
    return Coverage(
        azimuth,
        ranges,
        _counts(cells, azimuth, ranges),
        _looks(field, azimuth),
        ("azimuth, °", "range, m"),
        remarks,
    )


def _counts(views: Sequence[Array], x_edges: Array, y_edges: Array) -> Array:
    """(R, C) how many of views (N, 2) have a point in each cell; edges may descend."""
    x_sign, y_sign = (np.sign(edges[-1] - edges[0]) for edges in (x_edges, y_edges))
    edges = y_sign * y_edges, x_sign * x_edges
    hit = [np.histogram2d(y_sign * view[:, 1], x_sign * view[:, 0], edges)[0] > 0 for view in views]
    return np.asarray(np.sum(hit, axis=0, dtype=np.float64))


def _looks(field: Sequence[Array], azimuth: Array) -> NDArray[np.bool_]:
    """(C,) in which of azimuths from the left to the right a scanner measures anything."""
    return np.asarray(np.histogram(-_azimuth(np.concatenate(field)), -azimuth)[0] > 0)


def _azimuth(points: Array) -> Array:
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def _elevation(points: Array) -> Array:
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def _range(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points, axis=1))


def _sectors(views: Sequence[Array], field: Sequence[Array], what: str) -> tuple[str, ...]:
    """How much of the azimuths that a scanner sees its views cover, and which sectors they do not."""
    edges = np.arange(-180, 181, _SECTOR)
    seen, visible = (np.histogram(_azimuth(np.concatenate(of)), edges)[0] > 0 for of in (views, field))
    missing = np.flatnonzero(visible & ~seen)
    if not len(missing):
        return (f"{what} in all directions in which it sees.",)
    # Neighbouring sectors, also across ±180°, are one: counted from one that is not missing.
    turn = int(np.flatnonzero(~(visible & ~seen))[0]) if len(missing) < len(seen) else 0
    order = sorted((int(k) - turn) % len(seen) for k in missing)
    runs = [list(run) for _, run in groupby(enumerate(order), key=lambda one: one[1] - one[0])]
    spans = [_sector(edges[0] + _SECTOR * (run[0][1] + turn), len(run)) for run in runs]
    share = round(100 * int(np.sum(seen & visible)) / int(np.sum(visible)))
    return (f"{what} in {share} % of the directions in which it sees. Missing: {_listed(spans)}.",)


def _sector(start: int, count: int) -> str:
    """Azimuths as people say them, anticlockwise from the front."""
    low, high = ((start + 180) % 360) - 180, ((start + _SECTOR * count + 179) % 360) - 179
    middle = ((start + _SECTOR * count / 2 + 180) % 360) - 180
    names = ("ahead", "to the left", "behind", "to the right")
    return f"{fixed(low, 0)}° to {fixed(high, 0)}° ({names[round(middle / 90) % 4]})"


def _ranges(views: Sequence[Array], what: str) -> str:
    return f"{what} {_span(_range(np.concatenate(views)), 1)} m away."


def _span(values: Array, decimals: int) -> str:
    return f"{fixed(float(np.min(values)), decimals)} to {fixed(float(np.max(values)), decimals)}"


def _listed(things: Sequence[str]) -> str:
    return things[0] if len(things) == 1 else f"{', '.join(things[:-1])} and {things[-1]}"

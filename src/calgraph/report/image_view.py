"""Camera images with the board as predicted by the joint solution, and scanners' points coloured by residual."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.figures import choose_enlargement
from calgraph.report.templates import render
from calgraph.result import BoardOutline, BoardView, Calibration, SensorPose, Snapshot
from calgraph.result.calibrated_cameras import calibrated_cameras
from calgraph.result.evidence import rms
from calgraph.sensors import CameraModel

# Samples of a straight edge, which lenses bend.
_SAMPLES_PER_EDGE = 12
# Lines are clipped at this margin beyond the image, relative to its size, so that they reach its border.
_IMAGE_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class Overlay:
    """In pixels of the full image; NaN outside of the camera's view."""

    board_outlines: tuple[Array, ...]
    """(N, 2) outline of each board."""
    marks: tuple[Array, ...]
    """(N, 2) outline of each printed tag, or a single corner (1, 2)."""
    measured: Array
    """(M, 2) corners that the camera detected."""
    residuals: Array
    """(M, 2) measured minus predicted; NaN without a prediction."""
    points: Array
    """(P, 2) of scanners on the board."""
    distances: Array
    """(P,) signed distances of those points from the board's plane, m, positive behind it for the scanner."""


def compute_overlay(
    calibration: Calibration, rig: Rig, sensor: SensorPose, camera: CameraModel, capture: int
) -> Overlay:
    """Predictions and measurements of one capture in the image of one camera."""
    outlines = [
        o for o in calibration.pictures.board_outlines if o.capture == capture and np.isfinite(o.corners).all()
    ]
    views = [view for view in calibration.pictures.board_views if view.capture == capture]
    of_camera = [view for view in views if view.sensor == sensor.name]
    points, distance = _scanner_points(calibration, views)
    return Overlay(
        board_outlines=tuple(
            project_to_image(sample_outline(o.corners), sensor, camera, _IMAGE_MARGIN) for o in outlines
        ),
        marks=tuple(mark for o in outlines for mark in _project_print(o, rig, sensor, camera)),
        measured=np.concatenate([np.zeros((0, 2)), *(view.measured for view in of_camera)]),
        residuals=np.concatenate([np.zeros((0, 2)), *(_residuals_or_nan(view) for view in of_camera)]),
        points=project_to_image(points, sensor, camera),
        distances=distance,
    )


def project_to_image(points: Array, sensor: SensorPose, camera: CameraModel, margin: float = 0.0) -> Array:
    """Pixels (N, 2) of points (N, 3) in the root frame, m.

    NaN behind the camera, and outside of the image by more than ``margin`` times its size.
    """
    pixels = camera.project(se3.apply(se3.inverse(sensor.T_root_sensor), points))
    share = (pixels + 0.5) / (camera.width, camera.height)
    inside = np.all((share >= -margin) & (share < 1 + margin), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _residuals_or_nan(view: BoardView) -> Array:
    return np.full_like(view.measured, np.nan) if view.residuals is None else view.residuals


def sample_outline(corners: Array) -> Array:
    """(N, 3) points along the closed outline of corners (K, 3)."""
    t = np.linspace(0, 1, _SAMPLES_PER_EDGE, endpoint=False)[:, None, None]
    along = (1 - t) * corners + t * np.roll(corners, -1, axis=0)
    return np.concatenate([along.swapaxes(0, 1).reshape(-1, 3), corners[:1]])


def _project_print(outline: BoardOutline, rig: Rig, sensor: SensorPose, camera: CameraModel) -> Sequence[Array]:
    """Outlines (N, 2) of tags, or single corners (1, 2), in pixels; none without a camera's detection."""
    if outline.board is None or outline.board >= len(rig.boards):
        return ()
    marks = compute_landmarks(rig.boards[outline.board]).corners
    lines = [mark if len(mark) == 1 else sample_outline(mark) for mark in marks]
    if not lines:
        return ()
    points = se3.apply(_board_pose(outline.corners), np.concatenate(lines))
    ends = np.cumsum([len(line) for line in lines])[:-1]
    return np.split(project_to_image(points, sensor, camera, _IMAGE_MARGIN), ends)


def _board_pose(corners: Array) -> Array:
    """``T_root_board`` (4, 4) of a board's corners (4, 3), counter-clockwise from the bottom left."""
    x, y = (side / np.linalg.norm(side) for side in (corners[1] - corners[0], corners[3] - corners[0]))
    return se3.pose(np.column_stack([x, y, np.cross(x, y)]), corners.mean(axis=0))


def _scanner_points(calibration: Calibration, views: Sequence[BoardView]) -> tuple[Array, Array]:
    """Points (P, 3) of scanners on the board in the root frame, and their distances (P,) from its plane, m."""
    poses = {s.name: s.T_root_sensor for s in calibration.sensors}
    used = [v for v in views if v.residuals is not None and v.residuals.ndim == 1 and v.sensor in poses]
    points = [se3.apply(poses[view.sensor], view.measured) for view in used]
    offs = [view.residuals for view in used if view.residuals is not None]
    return np.concatenate([np.zeros((0, 3)), *points]), np.concatenate([np.zeros(0), *offs])


# Largest number of images on the page, largest and smallest number per camera.
_MAX_IMAGES, _MAX_PER_CAMERA, _MIN_PER_CAMERA = 36, 8, 2
# From blue, in front of the board, to red, behind it.
_COLOR_RAMP = ("#2166ac", "#67a9cf", "#d1e5f0", "#ffffff", "#fddbc7", "#ef8a62", "#b2182b")
# An image with less than this fraction of the bytes of the largest was stored at reduced size.
_MIN_SIZE_RATIO = 0.3
# Smallest drawn length of the median error, relative to the image width.
_VISIBLE_ERROR = 0.01


def render_camera_images(calibration: Calibration, rig: Rig) -> Markup:
    """A few images of each camera, from the largest error to the least; empty for a rig without cameras."""
    cameras = calibrated_cameras(calibration, rig)
    intrinsics = {sensor: cameras[sensor.name] for sensor in calibration.sensors if sensor.name in cameras}
    if not intrinsics:
        return Markup()
    images = _full_size_images(calibration.pictures.snapshots)
    limit = _color_limit(calibration.pictures.board_views)
    each = min(max(_MAX_IMAGES // len(intrinsics), _MIN_PER_CAMERA), _MAX_PER_CAMERA)
    shown = []
    for sensor, camera in intrinsics.items():
        views = _rank_views(calibration.pictures.of_sensor(sensor.name).board_views, images)
        factor = _choose_enlargement(views, camera) if views else 1
        ranks = np.unique(np.linspace(0, len(views) - 1, min(each, len(views))).round().astype(int)).tolist()
        shots = []
        for rank in ranks:
            capture = views[rank].capture
            taken = images.get((sensor.name, capture))
            drawn = compute_overlay(calibration, rig, sensor, camera, capture)
            shots.append({
                "rank": rank,
                "capture": capture,
                "image": b64encode(taken.image).decode() if taken else "",
                "paths": _draw_overlay(drawn, factor, limit),
                "error": rms(np.linalg.norm(drawn.residuals, axis=1)),
                "distance": rms(drawn.distances[np.isfinite(drawn.points[:, 0])]),
            })  # fmt: skip
        shown.append((sensor.name, camera, factor, len(views), shots))
    return render(
        "images.html",
        cameras=shown,
        with_images=bool(images),
        with_points=len(_scanner_points(calibration, calibration.pictures.board_views)[0]) > 0,
        limit=limit,
        ramp=_COLOR_RAMP,
    )


def _full_size_images(snapshots: Sequence[Snapshot]) -> dict[tuple[str, int], Snapshot]:
    """Images by camera and capture, without those stored at reduced size in long recordings."""
    images = [s for s in snapshots if s.image]
    size = {name: max(len(s.image) for s in images if s.sensor == name) for name in {s.sensor for s in images}}
    return {(s.sensor, s.capture): s for s in images if len(s.image) >= _MIN_SIZE_RATIO * size[s.sensor]}


def _rank_views(views: Sequence[BoardView], images: Mapping[tuple[str, int], Snapshot]) -> list[BoardView]:
    """The used views, from the largest error to the least; those with an image, where there are any."""
    with_image = [view for view in views if (view.sensor, view.capture) in images]
    used = [(rms(view.residuals), view) for view in with_image or views if view.residuals is not None]
    return [view for _, view in sorted(used, key=lambda one: -(one[0] or 0.0))]


def _draw_overlay(drawn: Overlay, factor: int, limit: float) -> list[tuple[str, ...]]:
    """Paths with CSS class and commands, points in a path for each colour."""
    predicted = drawn.measured - drawn.residuals
    errors = [np.stack([p, p + factor * d]) for p, d in zip(predicted, drawn.residuals, strict=True)]
    outlines = _draw_path(drawn.board_outlines)
    level = np.clip(np.round((drawn.distances / limit + 1) / 2 * (len(_COLOR_RAMP) - 1)), 0, len(_COLOR_RAMP) - 1)
    return [
        ("shade", outlines),
        ("board", outlines),
        ("mark", _draw_path(drawn.marks)),
        *(("points", _draw_path(drawn.points[level == k][:, None]), c) for k, c in enumerate(_COLOR_RAMP)),
        ("detected", _draw_path(drawn.measured[:, None])),
        ("error", _draw_path(errors)),
    ]


def _draw_path(lines: Sequence[Array] | Array) -> str:
    """Lines (N, 2) as one path, interrupted where they are NaN; a single point is a dot."""
    return "".join(_path_commands(line) for line in lines)


def _path_commands(line: Array) -> str:
    finite = np.asarray(np.isfinite(line).all(axis=1))
    if len(line) == 1:
        return f"M{line[0, 0]:.1f} {line[0, 1]:.1f}h0" if finite[0] else ""
    begins = finite & ~np.concatenate([[False], finite[:-1]])
    return "".join(
        f"{'M' if begin else 'L'}{x:.1f} {y:.1f}"
        for (x, y), begin in zip(line[finite], begins[finite], strict=True)
    )


def _choose_enlargement(views: Sequence[BoardView], camera: CameraModel) -> int:
    """Smallest enlargement at which the median error is visible."""
    errors = np.concatenate(
        [np.linalg.norm(view.residuals, axis=1) for view in views if view.residuals is not None]
    )
    return choose_enlargement(float(np.median(errors)), _VISIBLE_ERROR * camera.width)


def _color_limit(views: Sequence[BoardView]) -> float:
    """Distance of the ends of the colour ramp, m: twice the RMS of the noisiest scanner, rounded up."""
    residuals: dict[str, list[Array]] = {}
    for view in views:
        if view.residuals is not None and view.residuals.ndim == 1:
            residuals.setdefault(view.sensor, []).append(view.residuals)
    largest = max((rms(np.concatenate(values)) or 0.0 for values in residuals.values()), default=0.0)
    round_ones = (b * 10.0**e for e in range(-3, 2) for b in (1, 2, 3, 5))
    return next((step for step in round_ones if step >= 2 * largest), 50.0)

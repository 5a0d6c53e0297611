"""Pictures of the cameras with the board as the joint solution predicts it, and scanners' points by residual."""

from base64 import b64encode
from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.report.formatting import counted, digits, escaped, length
from calgraph.report.overlays import Overlay, overlay
from calgraph.result import BoardView, Calibration, SensorPose, Snapshot
from calgraph.result.evidence import rms
from calgraph.result.used_intrinsics import calibrated_cameras
from calgraph.sensors import CameraModel

# Pictures on the page, of each camera at most and at least, and of each those that are shown without asking.
_MOST, _EACH, _LEAST, _OPEN = 36, 8, 2, 4
# From blue, before the board, to red, beyond it.
_RAMP = ("#2166ac", "#67a9cf", "#d1e5f0", "#ffffff", "#fddbc7", "#ef8a62", "#b2182b")
# A picture with less than this share of the bytes of the largest was kept small.
_SMALL = 0.3
_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# A typical error is drawn by so much of the picture's width, and points so far off by twice the RMS are all red.
_VISIBLE = 0.01
_ABOUT = """Yellow is the board and its print where the joint solution of all sensors has them, white dots are the
corners that the camera saw; both should coincide. Pink lines are their differences, drawn larger. Dots in colours
are the points of scanners on the board:"""


def camera_images(calibration: Calibration, rig: Rig) -> str:
    """A few pictures of each camera, from the worst to the best; nothing for a rig without cameras."""
    cameras = calibrated_cameras(calibration, rig)
    known = {sensor: cameras[sensor.name] for sensor in calibration.sensors if sensor.name in cameras}
    if not known:
        return ""
    pictures = _large(calibration.pictures.snapshots)
    limit = _limit(calibration.pictures.board_views)
    each = min(max(_MOST // len(known), _LEAST), _EACH)
    shown = "".join(
        _camera(calibration, rig, sensor, camera, pictures, each, limit) for sensor, camera in known.items()
    )
    without = "" if pictures else " The pictures themselves are not part of this result."
    return f"<p>{_ABOUT}{without}</p>{_legend(limit)}{shown}"


def _camera(
    calibration: Calibration,
    rig: Rig,
    sensor: SensorPose,
    camera: CameraModel,
    pictures: Mapping[tuple[str, int], Snapshot],
    each: int,
    limit: float,
) -> str:
    title = f"<h3>{escaped(sensor.name)}</h3>"
    views = _ranked([view for view in calibration.pictures.board_views if view.sensor == sensor.name], pictures)
    if not views:
        return f'{title}<p class="empty">It saw the board in no capture that was used.</p>'
    factor = _exaggeration(views, camera)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(each, len(views))).round().astype(int)).tolist()
    shots = [
        _shot(
            views[rank],
            overlay(calibration, rig, sensor, camera, views[rank].capture),
            camera,
            pictures.get((sensor.name, views[rank].capture)),
            f"{_place(rank, len(views))} · differences drawn {factor} ×",
            factor,
            limit,
        )
        for rank in chosen
    ]
    rest = "".join(shots[_OPEN:])
    more = f'<details><summary>{len(shots) - _OPEN} more of {escaped(sensor.name)}</summary>\
<div class="grid large">{rest}</div></details>'
    return f'{title}<div class="grid large">{"".join(shots[:_OPEN])}</div>{more if rest else ""}'


def _large(snapshots: Sequence[Snapshot]) -> dict[tuple[str, int], Snapshot]:
    """Pictures by camera and capture, without those of long recordings that are kept too small for details."""
    pictures = [s for s in snapshots if s.image]
    size = {name: max(len(s.image) for s in pictures if s.sensor == name) for name in {s.sensor for s in pictures}}
    return {(s.sensor, s.capture): s for s in pictures if len(s.image) >= _SMALL * size[s.sensor]}


def _ranked(views: Sequence[BoardView], pictures: Mapping[tuple[str, int], Snapshot]) -> list[BoardView]:
    """The views that were used, from the largest error to the least; where there are pictures, those with one."""
    pictured = [view for view in views if (view.sensor, view.capture) in pictures]
    used = [(rms(view.residuals), view) for view in pictured or views if view.residuals is not None]
    return [view for _, view in sorted(used, key=lambda one: -(one[0] or 0.0))]


def _place(rank: int, count: int) -> str:
    if rank == 0:
        return f"largest error of {counted(count, 'picture')}"
    return "least error" if rank == count - 1 else f"error {rank + 1} of {count}"


def _shot(
    view: BoardView,
    drawn: Overlay,
    camera: CameraModel,
    picture: Snapshot | None,
    words: str,
    factor: int,
    limit: float,
) -> str:
    size = f"{camera.width} {camera.height}"
    described = escaped(f"{view.sensor} in capture {view.capture}")
    image = (
        f'<img alt="" loading="lazy" src="data:image/jpeg;base64,{b64encode(picture.image).decode()}">'
        if picture
        else f'<svg style="position:static" viewBox="0 0 {size}"></svg>'
    )
    error = rms(np.linalg.norm(drawn.off, axis=1))
    off = "" if error is None else f" · off by {digits(error)} px RMS"
    points = rms(drawn.distance[np.isfinite(drawn.points[:, 0])])
    beside = "" if points is None else f" · points {length(points)} RMS"
    return (
        f'<figure class="shot"><div role="img" aria-label="{described}">{image}'
        f'<svg viewBox="-0.5 -0.5 {size}" aria-hidden="true">{_drawing(drawn, factor, limit)}</svg></div>'
        f"<figcaption><b>Capture {view.capture}</b>{off}{beside} · {words}</figcaption></figure>"
    )


def _drawing(drawn: Overlay, factor: int, limit: float) -> str:
    predicted = drawn.seen - drawn.off
    errors = [np.stack([p, p + factor * d]) for p, d in zip(predicted, drawn.off, strict=True)]
    return (
        f"{_path('shade', drawn.sheets)}{_path('sheet', drawn.sheets)}{_path('mark', drawn.marks)}"
        f"{_points(drawn, limit)}{_path('seen', drawn.seen[:, None])}{_path('error', errors)}"
    )


def _points(drawn: Overlay, limit: float) -> str:
    """Points as one path a colour."""
    level = np.clip(np.round((drawn.distance / limit + 1) / 2 * (len(_RAMP) - 1)), 0, len(_RAMP) - 1)
    return "".join(
        _path("points", drawn.points[level == k][:, None], f' style="stroke:{color}"')
        for k, color in enumerate(_RAMP)
    )


def _path(css: str, lines: Sequence[Array] | Array, style: str = "") -> str:
    """Lines (N, 2) as one path, interrupted where they are NaN; a single point is a dot."""
    d = "".join(_commands(line) for line in lines)
    return f'<path class="{css}"{style} d="{d}"/>' if d else ""


def _commands(line: Array) -> str:
    finite = np.asarray(np.isfinite(line).all(axis=1))
    if len(line) == 1:
        return f"M{line[0, 0]:.1f} {line[0, 1]:.1f}h0" if finite[0] else ""
    begins = finite & ~np.concatenate([[False], finite[:-1]])
    return "".join(
        f"{'M' if begin else 'L'}{x:.1f} {y:.1f}"
        for (x, y), begin in zip(line[finite], begins[finite], strict=True)
    )


def _exaggeration(views: Sequence[BoardView], camera: CameraModel) -> int:
    """How many times larger differences must be drawn to be seen."""
    errors = np.concatenate(
        [np.linalg.norm(view.residuals, axis=1) for view in views if view.residuals is not None]
    )
    typical = float(np.median(errors))
    return next((f for f in _STEPS if f * typical >= _VISIBLE * camera.width), _STEPS[-1])


def _limit(views: Sequence[BoardView]) -> float:
    """How far off a point is red or blue, m: twice the RMS of the noisiest scanner, as a round number."""
    offs: dict[str, list[Array]] = {}
    for view in views:
        if view.residuals is not None and view.residuals.ndim == 1:
            offs.setdefault(view.sensor, []).append(view.residuals)
    largest = max((rms(np.concatenate(own)) or 0.0 for own in offs.values()), default=0.0)
    round_ones = (b * 10.0**e for e in range(-3, 2) for b in (1, 2, 3, 5))
    return next((step for step in round_ones if step >= 2 * largest), 50.0)


def _legend(limit: float) -> str:
    ramp = ", ".join(_RAMP)
    return (
        f'<p class="key">{length(limit)} before the board'
        f'<span class="ramp" style="background: linear-gradient(90deg, {ramp})"></span>'
        f"{length(limit)} beyond it</p>"
    )

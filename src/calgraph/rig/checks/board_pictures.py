"""Boards of the joint solution and their measurements by every sensor, for pictures of the result."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch
from calgraph.config import Rig
from calgraph.geometry import Array, plane, se3
from calgraph.result import BoardOutline, BoardView, FitError
from calgraph.result.evidence import rms
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet

InlierResiduals = Mapping[tuple[int, str], Mapping[int, Sequence[float]]]
"""By capture and sensor, residuals of its inlier matches, by candidate, m."""

# Most points of a view in a picture; more do not change what it shows.
_MAX_POINTS = 300


def collect_board_views(
    captures: CaptureSet, used: InlierResiduals, solution: RigSolution
) -> tuple[BoardView, ...]:
    """The measurements of each sensor in each capture: those in the bundle, otherwise the first detection."""
    solved = [_subsample_view(view) for view in _views_of_bundle(solution)]
    shown = {(view.capture, view.sensor) for view in solved}
    detected = [
        BoardView(
            capture,
            name,
            solution.solved_bundle is None and (capture, name) in used,
            _subsample_measurements(found[0]),
        )
        for name, by_capture in captures.detections.items()
        for capture, found in by_capture.items()
        if (capture, name) not in shown
    ]
    return tuple(sorted([*solved, *detected], key=lambda view: (view.capture, view.sensor)))


def measure_fit(solution: RigSolution) -> dict[str, FitError]:
    """RMS reprojection error of each camera, and RMS distance of each scanner's points from the boards."""
    residuals: dict[str, list[Array]] = {}
    for view in _views_of_bundle(solution):
        if view.residuals is not None:
            residuals.setdefault(view.sensor, []).append(view.residuals)
    joined = {name: np.concatenate(parts) for name, parts in residuals.items()}
    return {
        name: FitError(len(errors), "px", rms(np.linalg.norm(errors, axis=1)) or 0.0)
        if errors.ndim == 2
        else FitError(len(errors), "m", rms(errors) or 0.0)
        for name, errors in joined.items()
    }


def collect_board_outlines(
    rig: Rig, captures: CaptureSet, used: InlierResiduals, solution: RigSolution
) -> tuple[BoardOutline, ...]:
    """The board of each capture: as estimated by the bundle, otherwise as detected by a camera or 3-D LiDAR."""
    solved = list(_outlines_of_bundle(rig, captures, solution.solved_bundle)) if solution.solved_bundle else []
    estimated = {outline.capture for outline in solved}
    detected = (
        _detected_outline(rig, captures, used, solution, hold.index)
        for hold in captures.holds
        if hold.index not in estimated
    )
    return tuple(sorted([*solved, *filter(None, detected)], key=lambda outline: outline.capture))


def _views_of_bundle(solution: RigSolution) -> Iterator[BoardView]:
    if (solved := solution.solved_bundle) is None:
        return
    bundle, state = solved.bundle, solved.minimized.state
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        if not len(views.board):  # its pose is a prior
            continue
        T_sensor_board = relative_poses(state.T_root_sensor[s], state.T_root_board[views.board])
        residual = views.linearize(T_sensor_board, state.extra[bundle.extra_indices(s)]).residual
        if isinstance(views, CornerObservations):
            measured, errors = views.pixels, -residual * views.noise_scale * views.noise.pixel
        else:
            assert isinstance(views, RangeObservations)
            count = np.diff(views.start, append=len(views.ranges))
            normal = np.repeat(T_sensor_board[:, :3, 2], count, axis=0)
            measured = views.directions * views.ranges[:, None]
            errors = -residual[:, 0] * views.sigma * np.abs(np.sum(normal * views.directions, axis=1))
        parts = (np.split(values, views.start[1:]) for values in (measured, errors))
        for board, points, error in zip(views.board, *parts, strict=True):
            yield BoardView(int(solved.captures[board]), name, True, points, error)


def _subsample_view(view: BoardView) -> BoardView:
    step = len(view.measured) // _MAX_POINTS + 1
    residuals = None if view.residuals is None else view.residuals[::step]
    return replace(view, measured=view.measured[::step], residuals=residuals)


def _subsample_measurements(detection: Detection) -> Array:
    measured = detection.pixels if isinstance(detection, BoardCorners) else detection.points
    return np.asarray(measured[:: len(measured) // _MAX_POINTS + 1])


def _outlines_of_bundle(rig: Rig, captures: CaptureSet, solved: SolvedBundle) -> Iterator[BoardOutline]:
    """The outlines of boards that a camera detected: of others, the bundle estimates the plane only."""
    bundle, T_root_board = solved.bundle, solved.minimized.state.T_root_board
    done: set[int] = set()
    for name, views in zip(bundle.sensors, bundle.views, strict=True):
        for board, start in zip(views.board.tolist(), views.start, strict=True):
            if isinstance(views, CornerObservations) and board not in done:
                done.add(board)
                capture = int(solved.captures[board])
                found = captures.detections[name][capture]
                number = _board_number(found, views.pixels[start])
                yield BoardOutline(capture, se3.apply(T_root_board[board], _board_rectangle(rig, number)), number)


def _board_number(found: Sequence[Detection], pixel: Array) -> int:
    """Number of the board whose first corner was detected at a pixel (2,)."""
    return next(d.board for d in found if isinstance(d, BoardCorners) and np.array_equal(d.pixels[0], pixel))


def _detected_outline(
    rig: Rig, captures: CaptureSet, used: InlierResiduals, solution: RigSolution, capture: int
) -> BoardOutline | None:
    """The board of one capture as detected by a camera, otherwise by a 3-D LiDAR; None without either."""
    detections: list[tuple[Array, Detection]] = [
        (T, captures.detections[name][capture][k])
        for name, T in solution.T_root_sensor.items()
        for k in used.get((capture, name), {})
    ]
    for T, detection in detections:
        if isinstance(detection, BoardCorners):
            corners = se3.apply(T @ detection.T_camera_board, _board_rectangle(rig, detection.board))
            return BoardOutline(capture, corners, detection.board)
    for T, detection in detections:
        if isinstance(detection, PlanePatch):
            return BoardOutline(capture, se3.apply(T, _patch_rectangle(detection)))
    return None


def _board_rectangle(rig: Rig, number: int) -> Array:
    """(4, 3) corners of a board in the board frame, m."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.column_stack([signs * np.array(rig.boards[number].size) / 2, np.zeros(4)])


def _patch_rectangle(patch: PlanePatch) -> Array:
    """(4, 3) corners of the rectangle around a detected patch, in the sensor's frame, m."""
    basis = plane.tangent_basis(patch.plane[:3])
    _, _, axes = np.linalg.svd((patch.points - patch.center) @ basis, full_matrices=False)
    along = (patch.points - patch.center) @ basis @ axes.T
    low, high = np.percentile(along, [1, 99], axis=0)
    flat = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return np.asarray(patch.center + flat @ axes @ basis.T)

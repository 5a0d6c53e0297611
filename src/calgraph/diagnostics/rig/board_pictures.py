"""Where the joint solution has the boards, and what every sensor saw of them: for pictures of the result."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calgraph.captures import CaptureSet
from calgraph.config import Rig
from calgraph.detection import BoardCorners, Detection, PlanePatch
from calgraph.estimation.rig.observations import CornerObservations, RangeObservations, relative_poses
from calgraph.estimation.rig.solution import RigSolution, SolvedBundle
from calgraph.geometry import Array, plane, se3
from calgraph.result import BoardOutline, BoardView

InlierResiduals = Mapping[tuple[int, str], Mapping[int, Sequence[float]]]
"""By capture and sensor, residuals of its inlier matches, by candidate, m."""

# So many points of a view tell a picture as much as all of them.
_POINTS = 300


def collect_board_views(captured: CaptureSet, used: InlierResiduals, joint: RigSolution) -> tuple[BoardView, ...]:
    """What each sensor saw in each capture: as the bundle used it, otherwise what was detected first."""
    solved = list(_views_of_bundle(joint.solved_bundle)) if joint.solved_bundle else []
    shown = {(view.capture, view.sensor) for view in solved}
    detected = [
        BoardView(
            capture,
            name,
            joint.solved_bundle is None and (capture, name) in used,
            _subsample_measurements(found[0]),
        )
        for name, by_capture in captured.detections.items()
        for capture, found in by_capture.items()
        if (capture, name) not in shown
    ]
    return tuple(sorted([*solved, *detected], key=lambda view: (view.capture, view.sensor)))


def collect_board_outlines(
    rig: Rig, captured: CaptureSet, used: InlierResiduals, joint: RigSolution
) -> tuple[BoardOutline, ...]:
    """The board of each capture: where the bundle has the sheet, or as a camera or cloud saw it."""
    solved = list(_outlines_of_bundle(rig, captured, joint.solved_bundle)) if joint.solved_bundle else []
    placed = {outline.capture for outline in solved}
    detected = (
        _detected_outline(rig, captured, used, joint, hold.index)
        for hold in captured.holds
        if hold.index not in placed
    )
    return tuple(sorted([*solved, *filter(None, detected)], key=lambda outline: outline.capture))


def _views_of_bundle(adjusted: SolvedBundle) -> Iterator[BoardView]:
    bundle, state = adjusted.bundle, adjusted.minimized.state
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        if not len(views.board):  # placed by what is known of it
            continue
        T_sensor_board = relative_poses(state.T_root_sensor[s], state.T_root_board[views.board])
        residual = views.linearize(T_sensor_board, state.extra[bundle.extra_indices(s)]).residual
        if isinstance(views, CornerObservations):
            seen, off = views.pixels, -residual * views.noise_scale * views.noise.pixel
        else:
            assert isinstance(views, RangeObservations)
            count = np.diff(views.start, append=len(views.ranges))
            normal = np.repeat(T_sensor_board[:, :3, 2], count, axis=0)
            seen = views.directions * views.ranges[:, None]
            off = -residual[:, 0] * views.sigma * np.abs(np.sum(normal * views.directions, axis=1))
        parts = (np.split(values, views.start[1:]) for values in (seen, off))
        for board, own, error in zip(views.board, *parts, strict=True):
            step = len(own) // _POINTS + 1
            yield BoardView(int(adjusted.captures[board]), name, True, own[::step], error[::step])


def _subsample_measurements(detection: Detection) -> Array:
    seen = detection.pixels if isinstance(detection, BoardCorners) else detection.points
    return np.asarray(seen[:: len(seen) // _POINTS + 1])


def _outlines_of_bundle(rig: Rig, captured: CaptureSet, adjusted: SolvedBundle) -> Iterator[BoardOutline]:
    """The sheets of boards whose print a camera saw: of others, the bundle knows the plane only."""
    bundle, T_root_board = adjusted.bundle, adjusted.minimized.state.T_root_board
    drawn: set[int] = set()
    for name, views in zip(bundle.sensors, bundle.views, strict=True):
        for board, start in zip(views.board.tolist(), views.start, strict=True):
            if isinstance(views, CornerObservations) and board not in drawn:
                drawn.add(board)
                capture = int(adjusted.captures[board])
                found = captured.detections[name][capture]
                number = _board_number(found, views.pixels[start])
                yield BoardOutline(capture, se3.apply(T_root_board[board], _board_rectangle(rig, number)), number)


def _board_number(found: Sequence[Detection], pixel: Array) -> int:
    """Which of the rig's boards was found where its first corner is at a pixel (2,)."""
    return next(d.board for d in found if isinstance(d, BoardCorners) and np.array_equal(d.pixels[0], pixel))


def _detected_outline(
    rig: Rig, captured: CaptureSet, used: InlierResiduals, joint: RigSolution, capture: int
) -> BoardOutline | None:
    """The board of one capture as it was detected, best by a camera; None if neither camera nor cloud did."""
    seen: list[tuple[Array, Detection]] = [
        (T, captured.detections[name][capture][k])
        for name, T in joint.T_root_sensor.items()
        for k in used.get((capture, name), {})
    ]
    for T, detection in seen:
        if isinstance(detection, BoardCorners):
            corners = se3.apply(T @ detection.T_camera_board, _board_rectangle(rig, detection.board))
            return BoardOutline(capture, corners, detection.board)
    for T, detection in seen:
        if isinstance(detection, PlanePatch):
            return BoardOutline(capture, se3.apply(T, _patch_rectangle(detection)))
    return None


def _board_rectangle(rig: Rig, number: int) -> Array:
    """(4, 3) corners of a board in its own frame, m."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.column_stack([signs * np.array(rig.boards[number].size) / 2, np.zeros(4)])


def _patch_rectangle(patch: PlanePatch) -> Array:
    """(4, 3) corners of the patch that was seen, in the sensor's frame, m."""
    basis = plane.tangent_basis(patch.plane[:3])
    _, _, axes = np.linalg.svd((patch.points - patch.center) @ basis, full_matrices=False)
    along = (patch.points - patch.center) @ basis @ axes.T
    low, high = np.percentile(along, [1, 99], axis=0)
    flat = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return np.asarray(patch.center + flat @ axes @ basis.T)

"""From board observations to a bundle with start values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calgraph.boards.detections import BoardCorners
from calgraph.config import CameraSpec, Rig
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.board_observations import BoardObservation, board_number, initial_board_pose
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, view_state
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import BoardViews, relative_poses, stack_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.systematic_parameters import add_systematic_parameters
from calgraph.rig.captures.detect import CaptureSet
from calgraph.sensors import CameraModel

_MIN_CORNERS = 4
"""Number of corners that determine the pose of a board."""


# Initial standard deviation of a view's displacement, m: larger than that of a flat board and calibrated ranges
# (1 to 2 mm), so that few views are outliers before noise is estimated.
INITIAL_VIEW_BIAS = 0.003
# Initial standard deviation of the stamps of a moving board's views, s: of the size of exposure times and of the
# delays of drivers, so that few views are outliers before it is estimated.
_INITIAL_STAMP_ERROR = 0.005


def build_bundle(
    rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation], T_root_sensor: Mapping[str, Array]
) -> tuple[Bundle, BundleState]:
    """The bundle of the observed boards, and its start values."""
    names = tuple(T_root_sensor)
    T_root_board = stack_poses([initial_board_pose(board, captured.detections, T_root_sensor) for board in boards])
    views = tuple(
        _select_views(rig, captured, name, boards, relative_poses(T_root_sensor[name], T_root_board))
        for name in names
    )
    bundle = Bundle(
        names,
        views,
        body=np.arange(len(names)),
        bias_variance=np.zeros((len(names), 4)),
        lever=0.5 * max(rig.board_size),
    )
    initial, stamp = INITIAL_VIEW_BIAS, _INITIAL_STAMP_ERROR
    for k in range(len(names)):
        components = list(bundle.bias_components(k))
        of_view = np.array([initial, initial / bundle.lever, initial, stamp])
        bundle.bias_variance[k, components] = of_view[components] ** 2
    state = BundleState(stack_poses([T_root_sensor[name] for name in names]), T_root_board, np.zeros(0))
    number = np.array([board_number(board, captured.detections) for board in boards], dtype=np.intp)
    bundle, state = add_systematic_parameters(bundle, state, rig, number)
    return update_noise(bundle, state), state


def update_noise(bundle: Bundle, state: BundleState, scales: Sequence[float] | None = None) -> Bundle:
    """The bundle with the noise of its measurements at this state, and with other scales (K,) of it if given."""
    if scales is None:
        scales = [views.noise_scale for views in bundle.all_views]
    return bundle.with_views([
        views.update_noise(view_state(bundle, state, k)[0], scale)
        for k, (views, scale) in enumerate(zip(bundle.all_views, scales, strict=True))
    ])  # fmt: skip


# Minimum cosine between a beam and the board's normal (87°), at which smaller ones are truncated: ranges at
# grazing incidence are not linear in the pose.
_MIN_INCIDENCE_COSINE = 0.05


def _select_views(
    rig: Rig, captured: CaptureSet, name: str, boards: Sequence[BoardObservation], T_sensor_board: Array
) -> BoardViews:
    """One sensor's views of the boards, whose start poses (C, 4, 4) are given."""
    spec = rig.sensors[name]
    detected = [
        (i, captured.detections[name][board.capture][board.detection_index[name]])
        for i, board in enumerate(boards)
        if name in board.detection_index
    ]
    indices = [i for i, _ in detected]
    if isinstance(spec, CameraSpec):
        camera = captured.cameras[name]
        corners = [
            _leave_out_unprojected(d, camera, T_sensor_board[i])
            for i, d in detected
            if isinstance(d, BoardCorners)
        ]
        return CornerObservations.from_detections(indices, corners, camera, spec.noise)
    surfaces = [d for _, d in detected if not isinstance(d, BoardCorners)]
    return RangeObservations.from_detections(indices, surfaces, spec.noise, _MIN_INCIDENCE_COSINE)


def _leave_out_unprojected(detection: BoardCorners, camera: CameraModel, T_camera_board: Array) -> BoardCorners:
    """A detection without the corners that the camera's model does not project at the board's start pose.

    Models of wide lenses end at the extremum of their polynomials, which corners near the border of the image pass
    where intrinsics are slightly wrong. A board with fewer than four others is behind the camera, and stays so.
    """
    projected = np.isfinite(camera.project(se3.apply(T_camera_board, detection.corners_board))).all(axis=-1)
    if projected.all() or projected.sum() < _MIN_CORNERS:
        return detection
    return replace(detection, corners_board=detection.corners_board[projected], pixels=detection.pixels[projected])


def rebuild_bundle(
    rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation], solved: Bundle, state: BundleState
) -> tuple[Bundle, BundleState]:
    """The bundle of other boards, with the variances and parameters of a solved one, and its start values.

    Args:
        rig: the rig.
        captured: detections.
        boards: of the new bundle.
        solved: without outlines.
        state: its solution.
    """
    T_root_sensor = dict(zip(solved.sensors, state.T_root_sensor, strict=True))
    bundle, start = build_bundle(rig, captured, boards, T_root_sensor)
    value = {(p.of, p.quantity): x for p, x in zip(solved.extra_parameters, state.extra, strict=True)}
    extra = np.array([value.get((p.of, p.quantity), 0.0) for p in bundle.extra_parameters])
    bundle, start = replace(bundle, bias_variance=solved.bias_variance), replace(start, extra=extra)
    return update_noise(bundle, start, [views.noise_scale for views in solved.views]), start

"""A ring of cameras whose lenses have a residual distortion each: a thousand parameters, in little memory."""

import tracemalloc

import numpy as np
import pytest

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.config import Intrinsics
from calgraph.errors import Rejected
from calgraph.geometry import se3
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from many_cameras import NOISE, draw_cameras, make_rig, view_boards

CAMERAS, CAPTURES, MODEL_ERROR = 6, 24, 0.05


@pytest.mark.slow
def test_a_ring_of_cameras_takes_less_memory_than_a_matrix_of_each_board_or_candidate() -> None:
    rng = np.random.default_rng(0)
    rig = make_rig(CAMERAS)
    T_world_camera, lenses = draw_cameras(CAMERAS, 2.5, rng)
    stated = {
        name: spec.model_copy(update={"intrinsics": Intrinsics.from_camera(lens, model_error=MODEL_ERROR)})
        for (name, spec), lens in zip(rig.sensors.items(), lenses, strict=True)
    }
    rig = rig.model_copy(update={"sensors": stated})
    cameras = dict(zip(rig.sensors, lenses, strict=True))
    views = view_boards(rig, T_world_camera, lenses, CAPTURES, rng)
    detections = {
        name: {
            k: make_board_corners(pose, view.corners, view.pixels)
            for k, view in of_camera.items()
            if not isinstance(
                pose := fit_pose(view.ids, view.corners, view.pixels, cameras[name], NOISE), Rejected
            )
        }
        for name, of_camera in views.items()
    }
    captures = captures_from_detections(rig, detections, cameras)
    problem = build_problem_from_captures(rig, captures, RigOptions(folds=0), np.random.default_rng(0))
    tracemalloc.start()
    try:
        calibration = solve_problem(problem)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # Information of 300 candidates on 800 parameters would be 1.6 GB.
    assert peak < 0.3e9
    assert calibration.evidence.suggestions
    errors = []
    for sensor, T in zip(calibration.sensors[1:], T_world_camera[1:], strict=True):
        e = se3.difference(sensor.T_root_sensor, se3.inverse(T_world_camera[0]) @ T)
        errors.append(e @ np.linalg.solve(sensor.covariance, e) / 6)
    # Of 30 correlated squares; few captures leave centimetres.
    assert 0.2 < np.mean(errors) < 2.0

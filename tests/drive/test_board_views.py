"""Boards fixed in the room: derivatives, whitening, and the joint solution of cameras that never see one board."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.drive.board_views import BoardMeasurements, BoardView, SharedErrors
from calgraph.drive.states import SensorState
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline
from drive_scenes import drive

CAMERA = CameraModel(
    "pinhole",
    640,
    480,
    np.array([[420.0, 0, 322], [0, 424, 236], [0, 0, 1]]),
    np.array([-0.1, 0.02, 1e-3, -5e-4, 0.0]),
)
FISHEYE = CameraModel(
    "fisheye",
    640,
    480,
    np.array([[260.0, 0, 318], [0, 261, 241], [0, 0, 1]]),
    np.array([0.02, -0.01, 2e-3, -1e-4]),
)
# Optical axes ahead and to the left of the robot.
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MOUNTED = (
    se3.pose(so3.exp(np.array([0.0, 0.1, 0.3])) @ OPTICAL, np.array([0.3, 0.1, 0.4])),
    se3.pose(so3.exp(np.array([0.1, 0.0, 2.0])) @ OPTICAL, np.array([-0.2, 0.1, 0.6])),
)
CORNERS = np.array([[x, y, 0.0] for y in (0.2, 0.05, -0.1, -0.2) for x in (-0.25, -0.1, 0.0, 0.1, 0.25)])


def place_boards(poses: Array, count: int, rng: np.random.Generator) -> Array:
    """Poses (count, 4, 4) of boards some 2 m before each camera at times of the drive."""
    found = []
    for b in range(count):
        T = poses[int(rng.integers(len(poses)))] @ MOUNTED[b % 2]
        turn = so3.exp(rng.normal(0, 0.2, 3)) @ np.diag([1.0, -1, -1])
        found.append(T @ se3.pose(turn, np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.5, 2.5)])))
    return np.array(found)


def see(
    T_world_camera: Array, times: Array, boards: Array, camera: CameraModel, noise: float, rng: np.random.Generator
) -> list[BoardView]:
    """What a camera sees of boards at times."""
    views = []
    for time, T in zip(times, T_world_camera, strict=True):
        for b, T_world_board in enumerate(boards):
            T_camera_board = se3.inverse(T) @ T_world_board
            pixels = camera.project(se3.apply(T_camera_board, CORNERS))
            facing = T_camera_board[:3, 2] @ T_camera_board[:3, 3] < 0
            if facing and camera.contains(pixels).all() and np.linalg.norm(T_camera_board[:3, 3]) < 5:
                measured = pixels + rng.normal(0, noise, pixels.shape)
                views.append(BoardView(float(time), b, CORNERS, measured, T_camera_board))
    return views


def measure(
    duration: float, seed: int, cameras: tuple[CameraModel, ...] = (CAMERA, FISHEYE)
) -> tuple[BoardMeasurements, SplineTrajectory, list[SensorState], Array]:
    """Views of two cameras behind a root, the trajectory, states, and no errors of lenses and prints."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.2, duration - 0.2, 0.1)
    boards = place_boards(drive(times, 3), 4, rng)
    states = [SensorState(np.eye(4)), *(SensorState(T, 0.01 * k) for k, T in enumerate(MOUNTED))]
    views = [
        (k + 1, view)
        for k, camera in enumerate(cameras)
        for view in see(drive(times, 3) @ MOUNTED[k], times + 0.01 * k, boards, camera, 0.2, rng)
    ]
    lens = {1: slice(0, 9), 2: slice(9, 17)}
    # All prints share scale and aspect.
    prints = np.array([[17, 18, 19 + 2 * b, 20 + 2 * b] for b in range(4)])
    errors = SharedErrors({1: cameras[0], 2: cameras[1]}, lens, {1: 27, 2: 28}, prints, np.full((4, 2), 0.3))
    dense = np.arange(-0.5, duration + 0.5, 0.02)
    trajectory = fit_spline(Track(dense, drive(dense, 3)), 0.0, duration, 0.1)
    seen = sorted({view.board for _, view in views})
    found = BoardMeasurements.of_views(views, {b: boards[b] for b in seen}, errors)
    return found, trajectory, states, np.zeros(29)


@pytest.mark.parametrize("seed", [0, 1])
def test_derivatives_are_those_of_the_residuals(seed: int) -> None:
    """Against differences, in pixels: whitening uses the residuals themselves."""
    measured, trajectory, states, shared = measure(6.0, seed)
    rng = np.random.default_rng(seed)
    shared = shared + rng.normal(0, 1e-3, len(shared))
    # The flow of corners during the readout is that of the linearization.
    shared[27:] = 0.0
    no_bias = replace(measured, whitened=False)
    rows = no_bias.linearize(trajectory, states, shared)
    assert len(rows.residual) > 500

    def residual(control: Array, of_sensor: Array, boards: Array, others: Array) -> Array:
        moved = [state.moved(step) for state, step in zip(states, of_sensor, strict=True)]
        return no_bias.moved(boards).linearize(trajectory.moved(control), moved, others).residual

    h = 1e-6
    for _ in range(3):
        control = rng.normal(size=trajectory.control.shape) * h
        of_sensor = rng.normal(size=(3, 9)) * h
        boards, others = rng.normal(size=no_bias.unknown_count) * h, rng.normal(size=len(shared)) * h
        numeric = (
            residual(control, of_sensor, boards, shared + others)
            - residual(-control, -of_sensor, -boards, shared - others)
        ) / (2 * h)
        analytic = (
            rows.by_control @ control.ravel()
            + np.sum(rows.by_sensor * of_sensor[rows.sensor], axis=1)
            + rows.by_unknown @ boards
            + rows.by_shared @ others
        ) / h
        assert_allclose(numeric, analytic, atol=2e-3, rtol=1e-4)

"""Boards fixed in the room: derivatives, whitening, and the joint solution of cameras that never see one board."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calgraph.drive.adjustment import Adjustment, AdjustmentPriors, _add_motion_prior, adjust_drive
from calgraph.drive.board_views import BoardMeasurements, BoardView, SharedErrors
from calgraph.drive.board_world import chain_boards, measure_boards
from calgraph.drive.measurements import DrivePart
from calgraph.drive.sources.camera import CameraSource, split_views
from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorPoints, SensorState
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline
from drive_board_scenes import CAMERA, CORNERS, FISHEYE, MOUNTED, place_boards, see
from drive_scenes import drive


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
        of_sensor = rng.normal(size=(3, 6 + BESIDE_POSE)) * h
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


def test_noise_is_that_of_the_corners() -> None:
    """0.2 pixels."""
    measured, trajectory, states, shared = measure(6.0, 0)
    found = measured.reweighted(trajectory, states, shared, lambda J: np.zeros(J.shape[0]))
    assert found.spreads is not None
    assert_allclose(found.spreads[1:, 0], 0.2, rtol=0.1)
    assert found.spreads[1:, 1:].max() < 0.1


def solve_two_cameras(duration: float, seed: int, bias: float) -> tuple[Adjustment, Array]:
    """Two cameras that look apart, the first is the root; and the errors (7,) of the second's pose and clock.

    Corners of a view are displaced together by ``bias``, pixels; start values are off by centimetres and degrees.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0.2, duration - 0.2, 0.1)
    boards = place_boards(drive(times, 3), 8, rng)
    T = se3.inverse(MOUNTED[0]) @ MOUNTED[1]
    sources = []
    for k, clock in enumerate((0.0, 0.013)):
        seen = see(drive(times, 3) @ MOUNTED[k], times + clock, boards, CAMERA, 0.1, rng)
        sources.append(
            CameraSource([replace(view, pixels=view.pixels + bias * rng.normal(size=2)) for view in seen])
        )
    start = [
        SensorState(np.eye(4)),
        SensorState(se3.retract(T, rng.normal(0, 0.02, 6)), 0.013 + rng.normal(0, 0.01)),
    ]
    dense = np.arange(-0.5, duration + 0.5, 0.1)
    noisy = se3.retract(drive(dense, 3) @ MOUNTED[0], rng.normal(0, 0.003, (len(dense), 6)))
    trajectory = fit_spline(Track(dense, noisy), 0.0, duration, 0.1)
    prints = np.array([[18, 19, 20, 20]] * 8)
    errors = SharedErrors(
        {0: CAMERA, 1: CAMERA}, {0: slice(0, 9), 1: slice(9, 18)}, {}, prints, np.full((8, 2), 0.3)
    )
    none = SensorPoints(np.zeros((0, 3)), np.zeros(0))
    part = DrivePart([none, none], trajectory, measure_boards(sources, start, trajectory, errors), 18)
    stddev = np.zeros((2, 6 + BESIDE_POSE))
    stddev[1, :7] = [*[10.0] * 6, 0.1]
    priors = AdjustmentPriors(stddev, np.full(21, 1e-9))
    found = adjust_drive([part], start, priors)
    state = found.states[1]
    return found, np.array([*se3.difference(state.T_root_sensor, T), state.clock_offset - 0.013])


@pytest.mark.parametrize("bias", [0.0, 0.4])
def test_cameras_that_see_no_board_together_have_the_stated_errors(bias: float) -> None:
    """If the trajectory that follows views were not allowed for, NEES with 0.4 pixels would be 5."""
    squares, sizes = [], []
    for seed in range(4):
        found, error = solve_two_cameras(6.0, seed, bias)
        squares.append(float(error @ np.linalg.solve(found.covariance, error)) / 7)
        sizes.append(np.linalg.norm(error[:3]))
    # 28 degrees of freedom: 0.4 to 2.0 with 99.8 %.
    assert 0.4 < np.mean(squares) < 2.0
    assert np.median(sizes) < 0.003


def test_noise_of_the_trajectory_does_not_change_the_size_of_the_world() -> None:
    """A larger trajectory with larger prints is as likely."""
    rng = np.random.default_rng(0)
    trajectory = fit_spline(Track(np.arange(40) / 10, drive(np.arange(40) / 10, 3)), 0.0, 3.0, 0.1)
    trajectory = trajectory.moved(rng.normal(0, 0.01, trajectory.control.shape))
    size = trajectory.control.size
    H, g = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    _add_motion_prior(H, g, trajectory, size)
    larger = trajectory.control.copy()
    larger[:, 3:] = 0.0
    change = np.append(larger.ravel(), 1.0)
    assert abs(g @ change) < 1e-9 * np.linalg.norm(g) * np.linalg.norm(change)
    middle = len(larger) // 2 * 6
    held = (change @ H @ change) - 1e6 * np.sum(change[middle : middle + 6] ** 2)
    assert abs(held) < 1e-6 * np.abs(H).max()


def test_boards_are_chained_where_cameras_see_two_at_once() -> None:
    """The trajectory in the world of the chained boards is the true one."""
    rng = np.random.default_rng(1)
    times = np.arange(0, 20, 0.1)
    boards = place_boards(drive(times, 3), 10, rng)
    states = {0: SensorState(MOUNTED[0]), 1: SensorState(MOUNTED[1], 0.02)}
    sources = {
        k: CameraSource(see(drive(times, 3) @ MOUNTED[k], times + 0.02 * k, boards, CAMERA, 0.0, rng))
        for k in range(2)
    }
    track = chain_boards(sources, states)
    assert track is not None
    assert len(track.times) > 100
    true = drive(track.times, 3)
    moved = se3.inverse(track.poses[0]) @ track.poses
    assert_allclose(moved, np.asarray(se3.inverse(true[0]) @ true), atol=0.02)


def test_views_of_a_board_at_rest_count_once_a_second() -> None:
    """Their corners are wrong together."""
    view = BoardView(0.0, 0, CORNERS, np.full((20, 2), 100.0), np.eye(4))
    resting = [replace(view, time=k / 10) for k in range(30)]
    moving = [replace(view, time=3 + k / 10, pixels=view.pixels + 5.0 * k) for k in range(1, 6)]
    kept = CameraSource([*resting, *moving]).thin(np.random.default_rng(0)).views
    assert [one.time for one in kept if one.time < 3] == [0.0, 1.1, 2.2]
    assert sum(one.time > 3 for one in kept) == 5


def test_a_board_that_stays_in_view_is_not_left_for_another() -> None:
    """Segments of a trajectory have one board each."""
    view = BoardView(0.0, 0, CORNERS, np.zeros((20, 2)), np.eye(4))
    seen = [replace(view, time=k / 10, board=b) for k in range(20) for b in (0, 1)]
    seen += [replace(view, time=3 + k / 10, board=1) for k in range(5)]
    found = split_views(seen)
    assert [(one[0].board, len(one)) for one in found] == [(0, 20), (1, 5)]


def test_noise_is_estimated_at_the_solution_of_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the solution before, noise is too small and too large in turn, more so each time."""
    found: list[Array] = []
    reweighted = BoardMeasurements.reweighted

    def record(self: BoardMeasurements, *arguments: Any) -> BoardMeasurements:
        found.append(self.T_world_board)
        return reweighted(self, *arguments)

    monkeypatch.setattr(BoardMeasurements, "reweighted", record)
    adjusted, _ = solve_two_cameras(6.0, 0, 0.0)
    last = adjusted.parts[0].measurements[0]
    assert isinstance(last, BoardMeasurements)
    assert_array_equal(found[-1], last.T_world_board)

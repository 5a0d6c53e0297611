"""Tracks and splines against SciPy's, and their derivatives against numerical ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from calgraph.geometry import Array, se_n
from calgraph.surfaces.trajectory import SplineTrajectory, Track, evaluate_basis, fit_spline

DIMENSIONS = pytest.mark.parametrize("n", [2, 3])
STEP = 1e-5


def curve(n: int, count: int = 101) -> Track:
    """A curved path of 10 s that turns by more than a half, in space with roll and pitch."""
    t = np.linspace(0.0, 10.0, count)
    place = np.stack([np.sin(0.5 * t), 1 - np.cos(0.7 * t), 0.1 * np.sin(t)], axis=1)
    turn = np.stack([0.2 * np.sin(0.9 * t), 0.1 * np.cos(1.1 * t), 0.5 * t + 0.3 * np.sin(t)], axis=1)
    if n == 2:
        return Track(t, se_n.pose(se_n.exp(turn[:, 2:]), place[:, :2]))
    return Track(t, se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), place))


def corrected(n: int, rng: np.random.Generator) -> SplineTrajectory:
    """A spline whose control points are far from the reference: 0.1 m and 0.3 rad."""
    spline = fit_spline(curve(n), 0.5, 9.5, 0.5)
    change = rng.normal(size=spline.control.shape)
    return spline.moved(change * np.repeat([0.1, 0.3], [n, change.shape[1] - n]))


@DIMENSIONS
def test_a_track_is_linear_between_its_poses(n: int) -> None:
    a = se_n.exp(np.full(1 if n == 2 else 3, 0.2))
    half = se_n.exp(np.full(1 if n == 2 else 3, 0.3))
    R = np.stack([a, a @ half @ half])
    track = Track(np.array([1.0, 2.0]), se_n.pose(R, np.stack([np.zeros(n), np.arange(n) + 1.0])))
    found = track.at(np.array([1.5, 1.0, 2.0]))
    assert_allclose(se_n.translation(found), [(np.arange(n) + 1) / 2, np.zeros(n), np.arange(n) + 1], atol=1e-12)
    assert_allclose(se_n.rotation(found), [a @ half, R[0], R[1]], atol=1e-12)


@DIMENSIONS
def test_a_track_rests_outside_its_times(n: int) -> None:
    track = curve(n)
    assert_allclose(track.at(np.array([-3.0, 12.0])), track.poses[[0, -1]], atol=1e-12)


def test_headings_are_interpolated_the_short_way_past_half_a_turn() -> None:
    track = Track(np.array([0.0, 1.0]), se_n.pose(se_n.exp(np.radians([[170.0], [-170.0]])), np.zeros((2, 2))))
    assert_allclose(track.at(np.array([0.5]))[0, :2, :2], -np.eye(2), atol=1e-12)


def test_the_part_of_a_track_has_the_times_of_an_interval() -> None:
    part = curve(2).between(2.0, 3.0)
    assert_allclose(part.times, np.linspace(2, 3, 11))
    assert_allclose(part.poses, curve(2).poses[20:31])


def test_weights_of_control_points_add_up_to_one(rng: np.random.Generator) -> None:
    _, weights, slopes = evaluate_basis(rng.uniform(0, 7, 200), 10)
    assert_allclose(weights.sum(axis=1), 1)
    assert_allclose(slopes.sum(axis=1), 0, atol=1e-14)


def test_weights_and_slopes_are_those_of_scipy(rng: np.random.Generator) -> None:
    count = 10
    control = rng.normal(size=count)
    spline = BSpline(np.arange(-3.0, count + 1), control, 3)
    x = np.concatenate([rng.uniform(0, count - 3, 200), [0.0, 1.0, count - 3.0]])
    first, weights, slopes = evaluate_basis(x, count)
    window = control[first[:, None] + np.arange(4)]
    assert_allclose(np.sum(weights * window, axis=1), spline(x), atol=1e-13)
    assert_allclose(np.sum(slopes * window, axis=1), spline.derivative()(x), atol=1e-13)


def test_slopes_are_the_derivatives_of_weights() -> None:
    x = np.linspace(0.05, 0.95, 10)
    (_, ahead, _), (_, behind, _) = evaluate_basis(x + STEP, 5), evaluate_basis(x - STEP, 5)
    _, _, slopes = evaluate_basis(x, 5)
    assert_allclose(slopes, (ahead - behind) / (2 * STEP), atol=1e-9)


@DIMENSIONS
@pytest.mark.parametrize("intervals", [1, 2, 18])
def test_a_spline_passes_through_the_poses_at_its_knots(n: int, intervals: int) -> None:
    track = curve(n)
    spline = fit_spline(track, 0.5, 0.5 + 0.5 * intervals, 0.5)
    knots = 0.5 + 0.5 * np.arange(intervals + 1.0)
    assert spline.end == pytest.approx(knots[-1])
    assert_allclose(spline.at(knots).poses, track.at(knots), atol=1e-9)


@DIMENSIONS
def test_a_spline_follows_a_smooth_track_between_its_knots(n: int) -> None:
    """Knots of 0.25 s leave 2 mm, most of which is at the ends, whose second derivative is held at 0."""
    track = curve(n, 2001)
    times = np.linspace(1.5, 8.5, 333)
    error = se_n.difference(fit_spline(track, 0.5, 9.5, 0.25).at(times).poses, track.at(times))
    assert np.abs(error[:, :n]).max() < 1e-4
    assert np.abs(error[:, n:]).max() < 1e-5


def test_a_spline_covers_an_interval_that_is_no_multiple_of_its_spacing() -> None:
    spline = fit_spline(curve(2), 1.0, 3.2, 0.5)
    assert spline.end == pytest.approx(3.5)
    assert len(spline.control) == 8


@DIMENSIONS
def test_velocity_and_turn_rate_are_derivatives_of_the_pose(n: int, rng: np.random.Generator) -> None:
    spline = corrected(n, rng)
    times = rng.uniform(0.6, 9.4, 50)
    at = spline.at(times)
    moved = se_n.difference(spline.at(times + STEP).poses, spline.at(times - STEP).poses) / (2 * STEP)
    assert_allclose(at.velocity, moved[:, :n], atol=1e-7)
    assert_allclose(at.turn_rate, moved[:, n:], atol=1e-6)


@DIMENSIONS
def test_rotation_jacobian_is_the_turn_by_the_correction(n: int, rng: np.random.Generator) -> None:
    """Weights add up to one: a change of all control points changes the correction by just that."""
    spline = corrected(n, rng)
    times = rng.uniform(0.6, 9.4, 50)
    at = spline.at(times)
    numerical = np.empty_like(at.rotation_jacobian)
    for k in range(numerical.shape[-1]):
        change = np.zeros_like(spline.control)
        change[:, n + k] = STEP
        turned = se_n.difference(spline.moved(change).at(times).poses, spline.moved(-change).at(times).poses)
        numerical[:, :, k] = turned[:, n:] / (2 * STEP)
    assert_allclose(at.rotation_jacobian, numerical, atol=1e-8)


@DIMENSIONS
def test_a_control_point_moves_poses_by_its_weight(n: int, rng: np.random.Generator) -> None:
    spline = corrected(n, rng)
    times = rng.uniform(0.6, 9.4, 50)
    at = spline.at(times)
    change: Array = np.zeros_like(spline.control)
    change[7, :n] = 1.0
    moved = se_n.translation(spline.moved(change).at(times).poses) - se_n.translation(at.poses)
    weight = np.where(at.first[:, None] + np.arange(4) == 7, at.basis, 0).sum(axis=1)
    assert_allclose(moved, np.repeat(weight[:, None], n, axis=1), atol=1e-12)

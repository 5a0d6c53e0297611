"""Relative motions against a trajectory: derivatives, what they leave of exact motions, and estimated noise."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calgraph.drive.relative_motions import RelativeMotions, gather_motions
from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline

DIMENSIONS = pytest.mark.parametrize("n", [2, 3])
OFFSET = 0.137
NONE = np.zeros(0)


def path(times: Array, n: int) -> Array:
    """A smooth path, in space one that turns about all axes."""
    place = np.stack([3 * np.sin(0.2 * times), 2 * np.sin(0.31 * times), 0.3 * np.sin(0.5 * times)], axis=1)
    heading = 0.4 * times + 0.9 * np.sin(0.6 * times)
    if n == 2:
        return se_n.pose(se_n.exp(heading[:, None]), place[:, :2])
    turn = np.stack([0.3 * np.sin(0.8 * times), 0.3 * np.sin(0.5 * times + 1), heading], axis=1)
    return se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), place)


def mounted(n: int) -> Array:
    if n == 2:
        return se_n.pose(se_n.exp(np.array([-2.5])), np.array([0.4, -0.3]))
    return se_n.pose(se_n.exp(np.array([0.5, -1.0, 2.0])), np.array([0.4, -0.3, 0.7]))


def trajectory(n: int) -> SplineTrajectory:
    times: Array = np.arange(-20, 320) / 20
    return fit_spline(Track(times, path(times, n)), 0.0, 15.0, 0.1)


def measured(n: int, axes: Index | None = None, *, wheels: bool = False) -> RelativeMotions:
    times = 0.3 + OFFSET + np.arange(140) / 10
    poses = path(times - OFFSET, n) @ mounted(n)
    every: Index = np.arange(n + n * (n - 1) // 2)
    return gather_motions(
        0, times[:-1], times[1:], se_n.inverse(poses[:-1]) @ poses[1:], every if axes is None else axes,
        np.zeros(n + n * (n - 1) // 2), wheels=wheels,
    )  # fmt: skip


@DIMENSIONS
def test_exact_motions_agree_with_the_trajectory(n: int) -> None:
    errors, *_ = measured(n).evaluate(trajectory(n), SensorState(mounted(n), OFFSET))
    assert np.abs(errors).max() < 2e-5


@pytest.mark.parametrize(("n", "gyroscope"), [(2, False), (3, False), (3, True)])
def test_the_derivatives_are_those_of_the_errors(n: int, gyroscope: bool) -> None:
    rng = np.random.default_rng(0)
    d = n * (n - 1) // 2
    one = measured(n, np.arange(3, 6) if gyroscope else None, wheels=True)
    one = one.moved(rng.normal(0, 0.01, one.unknown_count))
    spline = trajectory(n)
    spline = spline.moved(rng.normal(0, 0.02, spline.control.shape))
    state = SensorState(se_n.retract(mounted(n), rng.normal(0, 0.05, n + d)), OFFSET + 0.02)
    errors, _, by_state, _ = one.evaluate(spline, state)
    # Without weights, which depend on the errors, too.
    rows = replace(one, noise=np.full(len(one.noise), 1e6)).linearize(spline, [state], NONE)
    scale = 1e6 / np.sqrt(5 / 4)
    M, step = errors.size, 1e-6
    for k, change in enumerate(step * np.eye(n + d + BESIDE_POSE)[: n + d + 1]):
        both = [one.evaluate(spline, state.moved(sign * change))[0] for sign in (1, -1)]
        assert_allclose(by_state[:, :, k], (both[0] - both[1]) / (2 * step), atol=2e-6)
    by_control = rows.by_control.toarray()[:M] * scale
    for k in rng.choice(spline.control.size, 30, replace=False):
        change = np.zeros(spline.control.size)
        change[k] = step
        both = [
            one.evaluate(spline.moved(sign * change.reshape(spline.control.shape)), state)[0] for sign in (1, -1)
        ]
        assert_allclose(by_control[:, k], (both[0] - both[1]).T.ravel() / (2 * step), atol=2e-6)
    for k in range(one.unknown_count):
        change = np.zeros(one.unknown_count)
        change[k] = step
        both = [one.moved(sign * change).evaluate(spline, state)[0] for sign in (1, -1)]
        assert_allclose(
            rows.by_unknown.toarray()[:M, k] * scale, (both[0] - both[1]).T.ravel() / (2 * step), atol=2e-6
        )


def test_noise_is_that_of_the_errors_without_outliers() -> None:
    """1 mm and 0.5 mrad, with each tenth motion wrong by twenty times as much; the trajectory is known."""
    rng = np.random.default_rng(0)
    exact = measured(3)
    stddev = np.repeat([1e-3, 5e-4], 3) * np.where(np.arange(139) % 10 == 0, 20, 1)[:, None]
    one = replace(exact, motions=se_n.retract(exact.motions, rng.normal(size=stddev.shape) * stddev))
    state = SensorState(mounted(3), OFFSET)
    for _ in range(15):
        one = one.reweighted(trajectory(3), [state], NONE, lambda J: np.zeros(J.shape[0]))
    assert (one.noise / np.repeat([1e-3, 5e-4], 3) < 1.6).all()
    assert (one.noise / np.repeat([1e-3, 5e-4], 3) > 0.7).all()


def test_a_change_that_motions_do_not_determine_has_no_derivative() -> None:
    up = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    one = replace(measured(3), undetermined=up)
    _, _, by_state, _ = one.evaluate(trajectory(3), SensorState(mounted(3), OFFSET))
    assert_allclose(by_state[:, :, :6] @ up, 0, atol=1e-12)
    assert np.abs(by_state[:, :, 0]).max() > 0.01

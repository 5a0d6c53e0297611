"""Batched least squares over poses: minima, directions without information, and infeasible starts."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.rig.pairs.line_matches import axis_aligned_rotations, gauss_newton

POINTS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0.5, 0], [0.3, -1, -0.7]])


def distances_to_points(T_true: Array, T: Array) -> tuple[Array, Array]:
    """Differences (K, 15) of transformed points from true ones, and their Jacobians; NaN beyond 5 m."""
    x = se3.apply(T, POINTS)
    r = x - se3.apply(T_true, POINTS)
    arm = x - T[:, None, :3, 3]
    J = np.concatenate([np.broadcast_to(np.eye(3), (*arm.shape, 3)), -so3.hat(arm)], axis=-1)
    r[np.linalg.norm(T[:, :3, 3], axis=1) > 5] = np.nan
    return r.reshape(len(T), -1), J.reshape(len(T), -1, 6)


@pytest.mark.parametrize("count", [1, 5])
def test_every_problem_reaches_its_minimum(rng: np.random.Generator, count: int) -> None:
    """From starts that are off by 0.5 m and 0.5 rad, one of which is exact."""
    T_true = se3.pose(so3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))
    start = se3.retract(T_true, 0.5 * rng.normal(size=(count, 6)) * (np.arange(count) > 0)[:, None])
    if count == 1:
        start = se3.retract(T_true, np.full((1, 6), 0.5))
    T, cost = gauss_newton(start, lambda T: distances_to_points(T_true, T), 0.03, 12)
    np.testing.assert_allclose(T, T_true, atol=1e-6)
    np.testing.assert_allclose(cost, 0, atol=1e-12)


def test_cost_is_the_mean_square_at_the_minimum(rng: np.random.Generator) -> None:
    """Two measurements of each point, 0.2 m apart along x: each is 0.1 m off one of three coordinates."""
    T_true = se3.pose(np.eye(3), np.zeros(3))[None]

    def residuals(T: Array) -> tuple[Array, Array]:
        r, J = distances_to_points(T_true, T)
        shift = np.tile([0.1, 0, 0], len(POINTS))
        return np.concatenate([r - shift, r + shift], axis=1), np.concatenate([J, J], axis=1)

    T, cost = gauss_newton(se3.retract(T_true, 0.1 * rng.normal(size=(1, 6))), residuals, 0.03, 12)
    np.testing.assert_allclose(T, T_true, atol=1e-6)
    assert cost == pytest.approx([0.01 / 3])


def test_directions_below_the_least_slope_keep_their_start() -> None:
    """Distances along z alone, of points near the origin: x, y and the yaw do not change them."""
    points = 0.1 * (POINTS - POINTS.mean(axis=0))  # so that heights and rotations are independent

    def measure_heights(T: Array) -> tuple[Array, Array]:
        arm = points @ np.swapaxes(T[:, :3, :3], -1, -2)
        z = np.broadcast_to([0.0, 0, 1], arm.shape)
        r = arm[..., 2] + T[:, None, 2, 3] - points[:, 2] - 1.0
        return r, np.concatenate([z, np.cross(arm, z)], axis=-1)

    start = se3.retract(np.eye(4)[None], np.array([[0.3, 0.2, 0.5, 0.02, -0.01, 0.0]]))
    slope = 0.2  # above those of roll and pitch, some 0.07 m per rad, and below that of z
    T, _ = gauss_newton(start, measure_heights, slope, 12)
    np.testing.assert_allclose(T[0, :2, 3], [0.3, 0.2], atol=1e-12)
    np.testing.assert_allclose(T[0, :3, :3], start[0, :3, :3], atol=1e-9)
    assert T[0, 2, 3] == pytest.approx(1.0, abs=0.01)
    T, cost = gauss_newton(start, measure_heights, 0.01, 12)
    np.testing.assert_allclose(T[0, :2, 3], [0.3, 0.2], atol=1e-9)
    np.testing.assert_allclose(cost, 0, atol=1e-9)


def test_an_infeasible_start_has_an_infinite_cost() -> None:
    T_true = np.tile(np.eye(4), (2, 1, 1))
    start = se3.retract(T_true, np.array([[9.0, 0, 0, 0, 0, 0], [0.3, 0, 0, 0, 0, 0]]))
    T, cost = gauss_newton(start, lambda T: distances_to_points(T_true, T), 0.03, 12)
    assert np.isinf(cost[0])
    np.testing.assert_allclose(T[1], np.eye(4), atol=1e-6)


def test_there_are_twenty_four_axis_aligned_rotations() -> None:
    R = axis_aligned_rotations()
    assert len(np.unique(R.reshape(-1, 9), axis=0)) == len(R) == 24
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.tile(np.eye(3), (24, 1, 1)))
    np.testing.assert_allclose(np.linalg.det(R), 1)

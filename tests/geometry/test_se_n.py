"""SE(2) and SE(3) by one code: derivatives against numerical ones, projections on rotations, and known values."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se_n

DIMENSIONS = [2, 3]


def random_rotations(rng: np.random.Generator, count: int, n: int) -> Array:
    return se_n.exp(rng.normal(size=(count, 1 if n == 2 else 3)))


def test_a_quarter_turn_in_the_plane_maps_x_to_y() -> None:
    R = se_n.exp(np.array([np.pi / 2]))
    assert_allclose(R @ [1.0, 0.0], [0.0, 1.0], atol=1e-15)
    assert_allclose(se_n.log(R), [np.pi / 2])
    assert_allclose(se_n.rotation_angle(R.T), np.pi / 2)


@pytest.mark.parametrize("n", DIMENSIONS)
def test_nearest_rotation_undoes_small_damage(n: int, rng: np.random.Generator) -> None:
    R = random_rotations(rng, 20, n)
    stretch = np.diag([1.1, 0.9, 1.3][:n])
    assert_allclose(se_n.nearest_rotation(R @ stretch), R, atol=1e-14)


@pytest.mark.parametrize("n", DIMENSIONS)
def test_nearest_rotation_of_a_reflection_flips_the_shortest_direction(n: int, rng: np.random.Generator) -> None:
    R = random_rotations(rng, 20, n)
    assert_allclose(se_n.nearest_rotation(R @ np.diag([1.0] * (n - 1) + [-0.2])), R, atol=1e-14)


def test_nearest_rotation_of_a_singular_matrix_keeps_its_directions() -> None:
    assert_allclose(se_n.nearest_rotation(np.diag([3.0, 2.0, 0.0])), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("n", DIMENSIONS)
def test_rotation_jacobian_is_the_derivative_of_a_rotated_point(n: int, rng: np.random.Generator) -> None:
    x, phi = rng.normal(size=n), 1e-6 * rng.normal(size=1 if n == 2 else 3)
    assert_allclose(se_n.exp(phi) @ x - x, se_n.rotation_jacobian(x) @ phi, atol=1e-11)


@pytest.mark.parametrize("n", DIMENSIONS)
def test_relative_pose_jacobians_are_derivatives(n: int, rng: np.random.Generator) -> None:
    dof = 3 if n == 2 else 6
    T_r_a, T_r_b = se_n.pose(random_rotations(rng, 2, n), rng.normal(size=(2, n)))
    by_a, by_b = se_n.relative_pose_jacobians(T_r_a, T_r_b)
    T_a_b = se_n.inverse(T_r_a) @ T_r_b
    for k in range(dof):
        step = 1e-6 * np.eye(dof)[k]
        moved_a = se_n.difference(se_n.inverse(se_n.retract(T_r_a, step)) @ T_r_b, T_a_b)
        moved_b = se_n.difference(se_n.inverse(T_r_a) @ se_n.retract(T_r_b, step), T_a_b)
        assert_allclose(moved_a / 1e-6, by_a[:, k], atol=1e-5)
        assert_allclose(moved_b / 1e-6, by_b[:, k], atol=1e-5)


@pytest.mark.parametrize("n", DIMENSIONS)
def test_functions_broadcast_over_leading_axes(n: int, rng: np.random.Generator) -> None:
    T = se_n.pose(random_rotations(rng, 4, n)[:, None], rng.normal(size=(5, n)))
    assert T.shape == (4, 5, n + 1, n + 1)
    assert_allclose(se_n.inverse(T) @ T, np.broadcast_to(np.eye(n + 1), T.shape), atol=1e-12)
    x = rng.normal(size=(4, 5, 7, n))
    assert_allclose(se_n.apply(se_n.inverse(T), se_n.apply(T, x)), x, atol=1e-12)

"""Planes: side, transformation, fit, and the chart in which their covariances are stated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calgraph.geometry import Array, plane, se3, so3


def direction(azimuth: float, z: float) -> Array:
    """The unit vector at an azimuth, rad, and a height."""
    across = np.sqrt(1 - z**2)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), z])


normals = st.builds(direction, st.floats(-np.pi, np.pi), st.floats(-1, 1))
planes = st.builds(lambda n, d: np.append(n, [d]), normals, st.floats(-20, 20))
translations = st.builds(lambda x, y, z: np.array([x, y, z]), *[st.floats(-10, 10)] * 3)
moves = st.builds(lambda axis, t: se3.pose(so3.exp(2 * axis), t), normals, translations)


def points_on(p: Array, spread: float, count: int, rng: np.random.Generator) -> Array:
    along = rng.uniform(-spread, spread, size=(count, 2)) @ plane.tangent_basis(p[:3]).T
    return np.asarray(-p[3] * p[:3] + along)


@given(planes)
def test_oriented_planes_point_at_the_sensor(p: Array) -> None:
    towards = plane.towards_origin(p)
    assert towards[3] >= 0
    assert_allclose(abs(towards @ p), p @ p)


def test_distance_is_positive_on_the_side_of_the_normal() -> None:
    wall = np.array([-1.0, 0, 0, 3])
    assert_allclose(plane.distance(wall, np.array([[0.0, 5, 5], [3, 1, 2], [4, 0, 0]])), [3, 0, -1])


def test_the_plane_of_a_board_contains_its_origin_and_has_its_z_axis() -> None:
    T_a_board = se3.pose(so3.exp(np.array([0, np.pi / 2, 0])), np.array([-2.0, 1, 1]))
    assert_allclose(plane.from_pose(T_a_board), [1, 0, 0, 2], atol=1e-15)


@given(moves, planes)
def test_moved_points_keep_their_distance_from_the_moved_plane(T_a_b: Array, p_b: Array) -> None:
    x_b = np.array([[0.3, -2.0, 5.0], [10.0, 0, 0]])
    moved = plane.distance(plane.transform(T_a_b, p_b), se3.apply(T_a_b, x_b))
    assert_allclose(moved, plane.distance(p_b, x_b), atol=1e-12)


@given(moves, planes)
def test_moving_there_and_back_gives_the_plane_back(T_a_b: Array, p_b: Array) -> None:
    back = plane.transform(se3.inverse(T_a_b), plane.transform(T_a_b, p_b))
    assert_allclose(back, p_b, atol=1e-13)


def test_fit_finds_a_plane_far_away_through_noise(rng: np.random.Generator) -> None:
    truth = plane.towards_origin(np.array([0.36, -0.48, 0.8, 30.0]))
    x = points_on(truth, 0.5, 2000, rng) + rng.normal(scale=0.01, size=(2000, 1)) * truth[:3]
    fitted = plane.fit(x)
    assert np.degrees(np.linalg.norm(np.cross(fitted[:3], truth[:3]))) < 0.1
    assert abs(plane.distance(fitted, x.mean(axis=0, keepdims=True))[0]) < 1e-12


def test_fit_of_three_points_goes_through_them() -> None:
    x = np.array([[1.0, 0, 2], [0, 1, 2], [0, 0, 2.5]])
    assert_allclose(plane.distance(plane.fit(x), x), 0, atol=1e-15)


def test_fit_points_at_the_sensor() -> None:
    x = np.array([[1.0, 0, 2], [0, 1, 2], [0, 0, 2]])
    assert_allclose(plane.fit(x), [0, 0, -1, 2], atol=1e-15)


def test_fit_weights_points(rng: np.random.Generator) -> None:
    truth = np.array([0, 0, -1.0, 3])
    x = points_on(truth, 1.0, 40, rng)
    x[::2, 2] += rng.normal(scale=0.3, size=20)
    weights = np.where(np.arange(40) % 2, 1e6, 1.0)
    assert_allclose(plane.fit(x, weights), truth, atol=1e-5)


def test_a_common_factor_of_the_weights_does_not_matter(rng: np.random.Generator) -> None:
    x = points_on(np.array([0, 0.6, -0.8, 3]), 1.0, 30, rng) + rng.normal(scale=0.05, size=(30, 3))
    assert_allclose(plane.fit(x, np.full(30, 2500.0)), plane.fit(x), atol=1e-12)


@given(normals)
def test_tangent_basis_is_right_handed_with_the_normal(n: Array) -> None:
    u, v = plane.tangent_basis(n).T
    assert_allclose(np.column_stack([u, v, n]).T @ np.column_stack([u, v, n]), np.eye(3), atol=1e-14)
    assert_allclose(np.cross(u, v), n, atol=1e-14)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_tangent_basis_exists_at_the_poles(z: float) -> None:
    basis = plane.tangent_basis(np.array([0, 0, z]))
    assert_allclose(basis.T @ basis, np.eye(2), atol=1e-15)


def test_tangent_basis_exists_at_the_equator() -> None:
    basis = plane.tangent_basis(np.array([[1.0, 0, 0.0], [1.0, 0, -0.0], [0, -1.0, -1e-300]]))
    assert_allclose(np.swapaxes(basis, -1, -2) @ basis, np.broadcast_to(np.eye(2), (3, 2, 2)), atol=1e-15)


@given(planes)
def test_chart_starts_at_the_plane_itself(p: Array) -> None:
    assert_allclose(plane.retract(p, np.zeros(3)), p, atol=1e-15)


@given(planes, st.builds(lambda a, b, d: np.array([a, b, d]), *[st.floats(-0.5, 0.5)] * 3))
def test_chart_stays_on_unit_normals(p: Array, delta: Array) -> None:
    assert np.linalg.norm(plane.retract(p, delta)[:3]) == pytest.approx(1, abs=1e-14)


@given(planes)
def test_chart_has_tangent_basis_and_offset_as_derivative(p: Array) -> None:
    h = 1e-6
    numeric = np.column_stack([(plane.retract(p, h * e) - plane.retract(p, -h * e)) / (2 * h) for e in np.eye(3)])
    expected = np.zeros((4, 3))
    expected[:3, :2], expected[3, 2] = plane.tangent_basis(p[:3]), 1
    assert_allclose(numeric, expected, atol=1e-8)


def test_functions_broadcast_over_planes(rng: np.random.Generator) -> None:
    p = plane.from_pose(se3.retract(np.eye(4), rng.uniform(-1, 1, size=(2, 5, 6))))
    delta = rng.uniform(-0.1, 0.1, size=(2, 5, 3))
    moved = plane.retract(p, delta)
    assert moved.shape == (2, 5, 4)
    assert_allclose(moved[1, 3], plane.retract(p[1, 3], delta[1, 3]), atol=1e-15)
    assert plane.distance(moved, np.zeros((2, 5, 7, 3))).shape == (2, 5, 7)

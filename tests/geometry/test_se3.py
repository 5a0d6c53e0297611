"""Poses against scipy's RigidTransform, the group's axioms, and covariances against numerical derivatives."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from calgraph.geometry import Array, se3, so3


def direction(azimuth: float, z: float) -> Array:
    """The unit vector at an azimuth, rad, and a height."""
    across = np.sqrt(1 - z**2)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), z])


translations = st.builds(lambda x, y, z: np.array([x, y, z]), *[st.floats(-50, 50)] * 3)
unit_vectors = st.builds(direction, st.floats(-np.pi, np.pi), st.floats(-1, 1))
angles = st.one_of(st.floats(0, 3.1), st.floats(0, 1e-3), st.floats(np.pi - 1e-3, np.pi - 1e-6))
rotation_vectors = st.builds(lambda axis, angle: angle * axis, unit_vectors, angles)
poses = st.builds(lambda phi, t: se3.pose(so3.exp(phi), t), rotation_vectors, translations)
tangents = st.builds(lambda t, phi: np.concatenate([t, phi]), translations, rotation_vectors)


@pytest.fixture
def T_a_b() -> Array:
    return se3.pose(so3.exp(np.array([0.4, -1.1, 0.7])), np.array([1.0, -2.0, 3.0]))


@pytest.fixture
def T_b_c() -> Array:
    return se3.pose(so3.exp(np.array([-2.0, 0.3, 0.5])), np.array([-0.5, 4.0, 0.2]))


@pytest.fixture
def covariances(rng: np.random.Generator) -> tuple[Array, Array]:
    A, B = rng.normal(scale=0.01, size=(2, 6, 6))
    return A @ A.T, B @ B.T


@given(poses, poses)
def test_products_agree_with_scipy(T_a_b: Array, T_b_c: Array) -> None:
    expected = RigidTransform.from_matrix(T_a_b) * RigidTransform.from_matrix(T_b_c)
    assert_allclose(T_a_b @ T_b_c, expected.as_matrix(), atol=1e-12)


@given(poses)
def test_inverse_agrees_with_scipy(T: Array) -> None:
    assert_allclose(se3.inverse(T), RigidTransform.from_matrix(T).inv().as_matrix(), atol=1e-12)


@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(T: Array) -> None:
    assert_allclose(T @ se3.inverse(T), np.eye(4), atol=1e-12)


@given(poses, poses)
def test_inverse_of_a_product_is_the_product_of_inverses_reversed(T_a_b: Array, T_b_c: Array) -> None:
    assert_allclose(se3.inverse(T_a_b @ T_b_c), se3.inverse(T_b_c) @ se3.inverse(T_a_b), atol=1e-11)


def test_apply_agrees_with_scipy(T_a_b: Array, rng: np.random.Generator) -> None:
    x_b = rng.normal(size=(9, 3))
    assert_allclose(se3.apply(T_a_b, x_b), RigidTransform.from_matrix(T_a_b).apply(x_b), atol=1e-14)


def test_apply_maps_the_origin_of_b_to_its_place_in_a(T_a_b: Array) -> None:
    assert_allclose(se3.apply(T_a_b, np.zeros((1, 3)))[0], [1, -2, 3])


def test_quaternions_are_read_in_the_order_x_y_z_w() -> None:
    T = se3.from_xyz_quaternion(np.array([1.0, 2, 3]), np.array([0.5, -0.5, 0.5, 0.5]))
    expected = RigidTransform.from_components([1, 2, 3], Rotation.from_quat([0.5, -0.5, 0.5, 0.5]))
    assert_allclose(T, expected.as_matrix(), atol=1e-15)


@given(poses, tangents)
def test_difference_undoes_retract(T: Array, delta: Array) -> None:
    assert_allclose(se3.difference(se3.retract(T, delta), T), delta, atol=1e-9)


@given(poses, poses)
def test_retract_by_the_difference_arrives(T_est: Array, T: Array) -> None:
    assert_allclose(se3.retract(T, se3.difference(T_est, T)), T_est, atol=1e-12)


def test_retract_moves_and_turns_about_the_fixed_axes(T_a_b: Array) -> None:
    moved = se3.retract(T_a_b, np.array([0.1, 0, 0, 0, 0, np.pi / 2]))
    assert_allclose(moved[:3, 3], [1.1, -2, 3])
    assert_allclose(moved[:3, :3], so3.exp(np.array([0, 0, np.pi / 2])) @ T_a_b[:3, :3])


def test_difference_is_the_error_of_the_first(T_a_b: Array) -> None:
    T_est = se3.pose(so3.exp(np.array([0, 0.02, 0])) @ T_a_b[:3, :3], T_a_b[:3, 3] + [0, 0, 0.05])
    assert_allclose(se3.difference(T_est, T_a_b), [0, 0, 0.05, 0, 0.02, 0], atol=1e-12)


def numeric_covariance(map_of: Callable[[Array], Array], T: Array, covariance: Array) -> Array:
    """First-order transport of a covariance of T through a map, by central differences."""
    h = 1e-6
    at = map_of(T)

    def change(delta: Array) -> Array:
        return se3.difference(map_of(se3.retract(T, delta)), at)

    columns = [(change(h * e) - change(-h * e)) / (2 * h) for e in np.eye(6)]
    J = np.stack(columns, axis=-1)
    return np.asarray(J @ covariance @ J.T)


def test_inverse_covariance_is_the_transported_one(T_a_b: Array, covariances: tuple[Array, Array]) -> None:
    expected = numeric_covariance(se3.inverse, T_a_b, covariances[0])
    assert_allclose(se3.inverse_covariance(T_a_b, covariances[0]), expected, rtol=1e-6, atol=1e-10)


def test_composed_covariance_is_the_sum_of_the_transported_ones(
    T_a_b: Array, T_b_c: Array, covariances: tuple[Array, Array]
) -> None:
    from_a_b = numeric_covariance(lambda T: T @ T_b_c, T_a_b, covariances[0])
    from_b_c = numeric_covariance(lambda T: T_a_b @ T, T_b_c, covariances[1])
    found = se3.compose_covariance(T_a_b, *covariances, T_b_c[:3, 3])
    assert_allclose(found, from_a_b + from_b_c, rtol=1e-6, atol=1e-10)


def test_inverting_a_covariance_twice_gives_it_back(T_a_b: Array, covariances: tuple[Array, Array]) -> None:
    inverse = se3.inverse_covariance(T_a_b, covariances[0])
    assert_allclose(se3.inverse_covariance(se3.inverse(T_a_b), inverse), covariances[0], atol=1e-14)


def test_composed_covariance_is_the_scatter_of_composed_poses(
    T_a_b: Array, T_b_c: Array, covariances: tuple[Array, Array], rng: np.random.Generator
) -> None:
    count = 20_000
    e_ab, e_bc = (rng.multivariate_normal(np.zeros(6), covariance, size=count) for covariance in covariances)
    errors = se3.difference(se3.retract(T_a_b, e_ab) @ se3.retract(T_b_c, e_bc), T_a_b @ T_b_c)
    stated = np.sqrt(np.diag(se3.compose_covariance(T_a_b, *covariances, T_b_c[:3, 3])))
    assert_allclose(errors.std(axis=0), stated, rtol=0.03)


def test_relative_covariance_is_the_transported_one(T_a_b: Array, T_b_c: Array, rng: np.random.Generator) -> None:
    """Both poses move, together and apart, by central differences."""
    A = rng.normal(scale=0.01, size=(12, 12))
    h = 1e-6

    def relative(delta: Array) -> Array:
        return se3.inverse(se3.retract(T_a_b, delta[:6])) @ se3.retract(T_b_c, delta[6:])

    J = np.stack([se3.difference(relative(h * e), relative(-h * e)) / (2 * h) for e in np.eye(12)], axis=-1)
    assert_allclose(se3.relative_covariance(T_a_b, T_b_c, A @ A.T), J @ A @ A.T @ J.T, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3), (0,)])
def test_every_map_works_on_any_leading_axes(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    delta = rng.uniform(-1, 1, size=(*shape, 6))
    T = se3.retract(np.eye(4), delta)
    assert T.shape == (*shape, 4, 4)
    assert_allclose(se3.difference(T, np.eye(4)), delta, atol=1e-14)
    assert se3.apply(T, np.zeros((5, 3))).shape == (*shape, 5, 3)
    assert_allclose(se3.inverse(se3.inverse(T)), T, atol=1e-14)


def test_one_rotation_serves_many_translations() -> None:
    T = se3.pose(np.eye(3), np.arange(6.0).reshape(2, 3))
    assert_allclose(T[1], [[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]])
